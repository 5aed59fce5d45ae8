//! `make eval`: runs the published experiments on one machine with real nodes and writes a report. Needs root.

#![forbid(unsafe_code)]

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Result, ensure};
use clap::{Parser, Subcommand};
use support::daemon::DaemonSetup;

use eval::cells::RunCache;
use eval::examples::EvalFixtures;
use eval::experiments::crowd::CrowdDaemon;
use eval::experiments::{
    codecs, cores, failover, map, memory, neighbours, outsourcing, overhead, scale, transparency,
};
use eval::section::{MissingMeasurement, Section};
use eval::{basis, estimate, interrupt, rehearsal, report, robot, sweep};

/// Requests per run of a quick evaluation.
const QUICK: usize = 6;

/// Experiments that a quick evaluation omits unless they are named: number, id, title, and the tests that cover the
/// same.
const LEFT_OUT: [(u8, &str, &str, &str); 4] = [
    (
        3,
        "memory",
        "A package that needs more memory than the robot has",
        "the stories eval and isolation",
    ),
    (
        6,
        "failover",
        "A network that becomes bad",
        "the stories failover and fallback",
    ),
    (
        9,
        "neighbours",
        "Robots beside each other",
        "the stories limits and sla of the virtual machine",
    ),
    (
        11,
        "overhead",
        "What the system itself adds",
        "benches/servant, benches/portal and benches/link",
    ),
];

/// Run the published experiments on this machine and write target/eval/report.html
#[derive(Debug, Parser)]
struct EvalArguments {
    /// Run a reduced evaluation of about two minutes: few requests per run, without the experiments that stories cover
    /// (unless named by --only)
    #[arg(long)]
    quick: bool,
    /// Run only these experiments, such as 1,4,7 (default: all)
    #[arg(long, value_delimiter = ',', value_name = "NUMBERS", value_parser = clap::value_parser!(u8).range(1..=11))]
    only: Vec<u8>,
    /// Discard stored results and measure everything again
    #[arg(long)]
    fresh: bool,
    /// Directory for the report and the stored results (default: target/eval, or target/eval-quick with --quick)
    #[arg(long, global = true, value_name = "DIRECTORY")]
    target: Option<PathBuf>,
    #[command(subcommand)]
    verb: Option<EvalCommand>,
}

#[derive(Debug, Subcommand)]
enum EvalCommand {
    /// Run inside a robot's sandbox
    #[command(hide = true)]
    Robot {
        /// File with the robot's plan
        order: PathBuf,
        /// File to which the robot's trace is written
        answer: PathBuf,
    },
    /// Run an empty evaluation, for tests
    #[command(hide = true)]
    Rehearse {
        /// Seconds for which its node runs
        seconds: f64,
    },
}

fn main() -> ExitCode {
    let arguments = EvalArguments::parse();
    let done = match &arguments.verb {
        Some(EvalCommand::Robot { order, answer }) => robot::main(order, answer).map(|()| true),
        _ => evaluate(&arguments),
    };
    match done {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Runs the evaluation; returns whether everything was measured.
fn evaluate(arguments: &EvalArguments) -> Result<bool> {
    ensure!(
        nix::unistd::geteuid().is_root(),
        "robots' places and servants are made by root: sudo make eval"
    );
    let target = arguments.target.clone().unwrap_or_else(|| {
        let name = if arguments.quick {
            "eval-quick"
        } else {
            "eval"
        };
        bench_report::root().join("target").join(name)
    });
    let cells = RunCache::new(target.join("cells"), arguments.fresh)?;
    let cells = cells.with_basis(basis::basis()?);
    interrupt::listen()?;
    for line in sweep::remove_all() {
        eprintln!("left by an evaluation before: {line}");
    }
    let place = tempfile::Builder::new().prefix(sweep::PREFIX).tempdir()?;
    sweep::claim(place.path())?;
    let daemon = DaemonSetup::new(&place.path().join("home")).start()?;
    let workshop = EvalFixtures::new(&daemon, place.path());
    let sections = match &arguments.verb {
        Some(EvalCommand::Rehearse { seconds }) => {
            vec![rehearsal::section(&cells, &workshop, *seconds)?]
        }
        _ => {
            let numbers = selected_numbers(arguments);
            estimate::print_estimate(arguments.quick, &numbers);
            let mut sections = run_experiments(arguments.quick, &numbers, &cells, &workshop);
            if arguments.only.is_empty() {
                sections.extend(left_out_sections(&numbers));
                sections.sort_by_key(|section| section.number);
            }
            sections
        }
    };
    // Written before the daemon is stopped, so that a failure there does not lose the results.
    let complete = report::write(&target, &sections, &cells)?;
    daemon.stop()?;
    Ok(complete)
}

/// Returns the numbers of the selected experiments.
fn selected_numbers(arguments: &EvalArguments) -> Vec<u8> {
    if !arguments.only.is_empty() {
        return arguments.only.clone();
    }
    let shown = |number: &u8| LEFT_OUT.iter().any(|(one, ..)| one == number);
    (1..=11)
        .filter(|number| !arguments.quick || !shown(number))
        .collect()
}

fn run_experiments(
    quick: bool,
    numbers: &[u8],
    cells: &RunCache,
    workshop: &EvalFixtures,
) -> Vec<Section> {
    let wanted = |number: u8| numbers.contains(&number);
    let most = quick.then_some(QUICK);
    let mut sections = Vec::new();
    if wanted(1) {
        sections.extend(run_experiment(1, || {
            let runs = transparency::measure(cells, workshop, most)?;
            Ok(vec![transparency::section(&runs)])
        }));
    }
    if [2, 4, 5].into_iter().any(wanted) {
        sections.extend(run_experiment(2, || {
            let runs = outsourcing::measure(cells, workshop, most)?;
            let mut made = vec![
                outsourcing::response_times(&runs)?,
                outsourcing::phases(&runs)?,
                outsourcing::jitter(&runs)?,
            ];
            made.retain(|section| wanted(section.number));
            Ok(made)
        }));
    }
    if wanted(2) {
        sections.extend(run_experiment(2, || {
            let studies = cores::measure(cells, workshop, quick)?;
            Ok(vec![cores::section(&studies)?])
        }));
    }
    if wanted(3) {
        sections.extend(run_experiment(3, || {
            let runs = memory::measure(cells, workshop)?;
            Ok(vec![memory::section(&runs)])
        }));
    }
    if wanted(6) {
        sections.extend(run_experiment(6, || {
            let runs = failover::measure(cells, workshop, quick)?;
            Ok(vec![failover::section(&runs)?])
        }));
    }
    if wanted(7) {
        sections.extend(run_experiment(7, || {
            let runs = map::measure(cells, workshop, most.map(|most| most * 5))?;
            Ok(vec![map::section(&runs)?])
        }));
    }
    if wanted(8) {
        sections.extend(run_experiment(8, || {
            let runs = codecs::measure(cells, workshop, quick)?;
            Ok(vec![codecs::section(&runs)?])
        }));
    }
    if [9, 10].into_iter().any(wanted) {
        match workshop.directory() {
            Ok(place) => {
                let mut yard = CrowdDaemon::new(place.path());
                if wanted(9) {
                    sections.extend(run_experiment(9, || {
                        let runs = neighbours::measure(cells, &mut yard, quick)?;
                        Ok(vec![neighbours::section(&runs)?])
                    }));
                }
                if wanted(10) {
                    sections.extend(run_experiment(10, || {
                        let runs = scale::measure(cells, &mut yard, quick)?;
                        Ok(vec![scale::section(&runs)?])
                    }));
                }
            }
            Err(error) => sections.push(failure_section(9, &error)),
        }
    }
    if wanted(11) {
        sections.extend(run_experiment(11, || {
            let runs = overhead::measure(cells)?;
            Ok(vec![overhead::section(&runs)?])
        }));
    }
    sections.sort_by_key(|section| section.number);
    sections
}

/// Runs an experiment; if it fails as a whole, returns a section with the reason, so that the others continue.
fn run_experiment(number: u8, made: impl FnOnce() -> Result<Vec<Section>>) -> Vec<Section> {
    made().unwrap_or_else(|error| vec![failure_section(number, &error)])
}

/// Creates the section of an experiment that failed as a whole.
fn failure_section(number: u8, error: &anyhow::Error) -> Section {
    let title = format!("Experiment {number}");
    let mut section = Section::new(number, format!("failed-{number}"), title);
    let why = format!("{error:#}");
    section
        .missing
        .push(MissingMeasurement::retryable("the whole experiment", why));
    section
}

/// Creates sections for the experiments that were omitted.
fn left_out_sections(numbers: &[u8]) -> Vec<Section> {
    let left_out = LEFT_OUT
        .into_iter()
        .filter(|(number, ..)| !numbers.contains(number));
    left_out
        .map(|(number, id, title, shown)| {
            let mut section = Section::new(number, id, title);
            section.findings.push(format!(
                "A quick evaluation leaves this out: {shown} run the same of the programs. make eval measures it."
            ));
            section
        })
        .collect()
}
