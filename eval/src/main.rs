//! `make eval`: runs the published experiments on one machine with real nodes and writes a report. Needs root.
//!
//! ```text
//!  experiments ── run ──▶ results (target/eval/cells: raw data, one file per run)
//!                            │ evaluated by functions that are tested with known input
//!                            ▼
//!                         sections ──▶ report.html, report.json, one SVG per figure
//! ```
//! An interrupted evaluation continues where it stopped. The report lists what could not be measured, with the reason.

#![forbid(unsafe_code)]

mod application;
mod basis;
mod cells;
mod deadline;
mod examples;
mod experiments;
mod interrupt;
mod network;
mod page;
mod pictures;
mod place;
mod plots;
mod recording;
mod rehearsal;
mod report;
mod robot;
mod section;
mod statistics;
mod stream;
mod sweep;
mod trace;
mod words;

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Result, ensure};
use clap::{Parser, Subcommand};
use support::claim;
use support::daemon::DaemonSetup;

use crate::cells::{REPEATS, RunCache};
use crate::examples::EvalFixtures;
use crate::experiments::crowd::CrowdDaemon;
use crate::experiments::{
    codecs, cores, failover, map, memory, neighbours, outsourcing, overhead, scale, transparency,
};
use crate::section::{AGAIN, About, Section};

/// Requests per run of a quick evaluation.
const QUICK: usize = 6;

/// Everything that experiments need.
struct Evaluation<'a> {
    cells: &'a RunCache,
    workshop: &'a EvalFixtures<'a>,
    crowd: CrowdDaemon,
    quick: bool,
}

impl Evaluation<'_> {
    /// Returns the maximum number of requests per run.
    fn max_requests(&self) -> Option<usize> {
        self.quick.then_some(QUICK)
    }
}

/// Experiments that are measured together.
struct Experiment {
    abouts: &'static [&'static About],
    /// Seconds of a quick and of a full evaluation, on a machine with two cores and with packages compiled earlier.
    seconds: [u32; 2],
    /// The tests that cover the same, if a quick evaluation omits it unless it is named.
    covered_by: Option<&'static str>,
    /// Measures them, and creates their sections.
    run: fn(&mut Evaluation) -> Result<Vec<Section>>,
}

/// All experiments.
static EXPERIMENTS: [Experiment; 10] = [
    Experiment {
        abouts: &[&transparency::ABOUT],
        seconds: [55, 300],
        covered_by: None,
        run: |all| {
            Ok(vec![transparency::section(&transparency::measure(all.cells, all.workshop, all.max_requests())?)])
        },
    },
    Experiment {
        abouts: &[&outsourcing::RESPONSE_TIMES, &outsourcing::PHASES, &outsourcing::JITTER],
        seconds: [20, 1600],
        covered_by: None,
        run: |all| {
            let runs = outsourcing::measure(all.cells, all.workshop, all.max_requests())?;
            Ok(vec![outsourcing::response_times(&runs), outsourcing::phases(&runs), outsourcing::jitter(&runs)])
        },
    },
    Experiment {
        abouts: &[&cores::ABOUT],
        seconds: [0, 0],
        covered_by: None,
        run: |all| Ok(vec![cores::section(&cores::measure(all.cells, all.workshop, all.quick)?)]),
    },
    Experiment {
        abouts: &[&memory::ABOUT],
        seconds: [60, 180],
        covered_by: Some("the stories eval and isolation"),
        run: |all| Ok(vec![memory::section(&memory::measure(all.cells, all.workshop)?)]),
    },
    Experiment {
        abouts: &[&failover::ABOUT],
        seconds: [30, 1200],
        covered_by: Some("the stories failover and fallback"),
        run: |all| Ok(vec![failover::section(&failover::measure(all.cells, all.workshop, all.quick)?)]),
    },
    Experiment {
        abouts: &[&map::ABOUT],
        seconds: [10, 1100],
        covered_by: None,
        run: |all| {
            Ok(vec![map::section(&map::measure(all.cells, all.workshop, all.max_requests().map(|most| most * 5))?)])
        },
    },
    Experiment {
        abouts: &[&codecs::ABOUT],
        seconds: [20, 1250],
        covered_by: None,
        run: |all| Ok(vec![codecs::section(&codecs::measure(all.cells, all.workshop, all.quick)?)]),
    },
    Experiment {
        abouts: &[&neighbours::ABOUT],
        seconds: [20, 1500],
        covered_by: Some("the stories limits and sla of the virtual machine"),
        run: |all| Ok(vec![neighbours::section(&neighbours::measure(all.cells, &mut all.crowd, all.quick)?)]),
    },
    Experiment {
        abouts: &[&scale::ABOUT],
        seconds: [15, 330],
        covered_by: None,
        run: |all| Ok(vec![scale::section(&scale::measure(all.cells, &mut all.crowd, all.quick)?)]),
    },
    Experiment {
        abouts: &[&overhead::ABOUT],
        seconds: [0, 900],
        covered_by: Some("benches/servant, benches/portal and benches/link"),
        run: |all| Ok(vec![overhead::section(&overhead::measure(all.cells)?)]),
    },
];

/// Run the published experiments on this machine and write target/eval/report.html
#[derive(Debug, Parser)]
struct EvalArguments {
    /// Run a reduced evaluation of about two minutes: one run of few requests each, without the experiments that
    /// stories cover (unless named by --only)
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
        Ok(is_complete) => ExitCode::from(u8::from(!is_complete)),
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Runs the evaluation; returns whether everything was measured.
fn evaluate(arguments: &EvalArguments) -> Result<bool> {
    ensure!(nix::unistd::geteuid().is_root(), "robots' places and servants are made by root: sudo make eval");
    let target = arguments.target.clone().unwrap_or_else(|| {
        let name = if arguments.quick { "eval-quick" } else { "eval" };
        bench_report::root().join("target").join(name)
    });
    let repeats = if arguments.quick { 1 } else { REPEATS };
    let cells = RunCache::new(target.join("cells"), arguments.fresh, basis::basis()?, repeats)?;
    interrupt::listen()?;
    for line in sweep::remove_all() {
        eprintln!("left by an evaluation before: {line}");
    }
    let place = tempfile::Builder::new().prefix(sweep::PREFIX).tempdir()?;
    claim::claim(place.path())?;
    let daemon = DaemonSetup::new(&place.path().join("home")).start()?;
    let workshop = EvalFixtures::new(&daemon, place.path());
    let sections = match &arguments.verb {
        Some(EvalCommand::Rehearse { seconds }) => vec![rehearsal::section(&cells, &workshop, *seconds)?],
        _ => {
            let directory = workshop.directory()?;
            let crowd = CrowdDaemon::new(directory.path());
            run_experiments(arguments, Evaluation { cells: &cells, workshop: &workshop, crowd, quick: arguments.quick })
        }
    };
    // Written before the daemon is stopped, so that a failure there does not lose the results.
    let complete = report::write(&target, &sections, &cells)?;
    daemon.stop()?;
    Ok(complete)
}

/// Runs the experiments that are named, or all: a quick evaluation then says where else those that it omits are
/// covered. If an experiment fails as a whole, a section has the reason, and the others continue.
fn run_experiments(arguments: &EvalArguments, mut evaluation: Evaluation) -> Vec<Section> {
    let quick = evaluation.quick;
    let is_wanted = |number: u8| arguments.only.is_empty() || arguments.only.contains(&number);
    let wanted = EXPERIMENTS.iter().filter(|one| one.abouts.iter().any(|about| is_wanted(about.number)));
    let is_omitted = |one: &Experiment| quick && arguments.only.is_empty() && one.covered_by.is_some();
    let (omitted, wanted): (Vec<&Experiment>, Vec<_>) = wanted.partition(|one| is_omitted(one));
    let seconds = wanted.iter().map(|one| one.seconds[usize::from(!quick)]);
    eprintln!(
        "this takes about {} min on a machine of two cores, less what was measured before; packages that were never \
         compiled take some minutes more\nmin:s  run",
        seconds.sum::<u32>().div_ceil(60)
    );
    let mut sections = Vec::new();
    for one in wanted {
        match (one.run)(&mut evaluation) {
            Ok(made) => sections.extend(made.into_iter().filter(|made| is_wanted(made.number))),
            Err(error) => {
                let failed = one.abouts.iter().find(|about| is_wanted(about.number));
                sections.extend(failed.map(|about| {
                    let mut section = about.section();
                    section.add_missing("the whole experiment", format!("{error:#}"), AGAIN);
                    section
                }));
            }
        }
    }
    sections.extend(omitted.into_iter().map(|one| {
        let mut section = one.abouts[0].section();
        let covered = one.covered_by.unwrap_or_default();
        section.findings.push(format!(
            "A quick evaluation leaves this out: {covered} run the same of the programs. make eval measures it."
        ));
        section
    }));
    sections.sort_by_key(|section| section.number);
    sections
}
