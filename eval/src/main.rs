//! `make eval`: runs the published experiments on one machine with real nodes and writes a report. Needs root.

#![forbid(unsafe_code)]

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Result, ensure};
use clap::{Parser, Subcommand};
use support::claim;
use support::daemon::DaemonSetup;

use eval::cells::RunCache;
use eval::examples::EvalFixtures;
use eval::experiments::crowd::CrowdDaemon;
use eval::experiments::{codecs, cores, failover, map, memory, neighbours, outsourcing, overhead, scale, transparency};
use eval::section::{MissingMeasurement, Section};
use eval::{basis, interrupt, rehearsal, report, robot, sweep};

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
    fn most(&self) -> Option<usize> {
        self.quick.then_some(QUICK)
    }
}

/// Experiments that are measured together.
struct Experiment {
    /// Their numbers.
    numbers: &'static [u8],
    /// Seconds of a quick and of a full evaluation, on a machine with two cores and with packages compiled earlier.
    seconds: [u32; 2],
    /// Id, title and the tests that cover the same, if a quick evaluation omits it unless it is named.
    left_out: Option<[&'static str; 3]>,
    /// Measures them, and creates their sections.
    run: fn(&mut Evaluation) -> Result<Vec<Section>>,
}

/// All experiments.
static EXPERIMENTS: [Experiment; 10] = [
    Experiment {
        numbers: &[1],
        seconds: [55, 300],
        left_out: None,
        run: |all| {
            let runs = transparency::measure(all.cells, all.workshop, all.most())?;
            Ok(vec![transparency::section(&runs)])
        },
    },
    Experiment {
        numbers: &[2, 4, 5],
        // With that of cores.
        seconds: [20, 540],
        left_out: None,
        run: |all| {
            let runs = outsourcing::measure(all.cells, all.workshop, all.most())?;
            Ok(vec![outsourcing::response_times(&runs)?, outsourcing::phases(&runs)?, outsourcing::jitter(&runs)?])
        },
    },
    Experiment {
        numbers: &[2],
        seconds: [0, 0],
        left_out: None,
        run: |all| {
            let studies = cores::measure(all.cells, all.workshop, all.quick)?;
            Ok(vec![cores::section(&studies)?])
        },
    },
    Experiment {
        numbers: &[3],
        seconds: [60, 60],
        left_out: Some([
            "memory",
            "A package that needs more memory than the robot has",
            "the stories eval and isolation",
        ]),
        run: |all| {
            let runs = memory::measure(all.cells, all.workshop)?;
            Ok(vec![memory::section(&runs)])
        },
    },
    Experiment {
        numbers: &[6],
        seconds: [30, 390],
        left_out: Some(["failover", "A network that becomes bad", "the stories failover and fallback"]),
        run: |all| {
            let runs = failover::measure(all.cells, all.workshop, all.quick)?;
            Ok(vec![failover::section(&runs)?])
        },
    },
    Experiment {
        numbers: &[7],
        seconds: [10, 365],
        left_out: None,
        run: |all| {
            let most = all.most().map(|most| most * 5);
            let runs = map::measure(all.cells, all.workshop, most)?;
            Ok(vec![map::section(&runs)?])
        },
    },
    Experiment {
        numbers: &[8],
        seconds: [20, 420],
        left_out: None,
        run: |all| {
            let runs = codecs::measure(all.cells, all.workshop, all.quick)?;
            Ok(vec![codecs::section(&runs)?])
        },
    },
    Experiment {
        numbers: &[9],
        seconds: [20, 500],
        left_out: Some(["neighbours", "Robots beside each other", "the stories limits and sla of the virtual machine"]),
        run: |all| {
            let runs = neighbours::measure(all.cells, &mut all.crowd, all.quick)?;
            Ok(vec![neighbours::section(&runs)?])
        },
    },
    Experiment {
        numbers: &[10],
        seconds: [15, 110],
        left_out: None,
        run: |all| {
            let runs = scale::measure(all.cells, &mut all.crowd, all.quick)?;
            Ok(vec![scale::section(&runs)?])
        },
    },
    Experiment {
        numbers: &[11],
        seconds: [0, 300],
        left_out: Some(["overhead", "What the system itself adds", "benches/servant, benches/portal and benches/link"]),
        run: |all| {
            let runs = overhead::measure(all.cells)?;
            Ok(vec![overhead::section(&runs)?])
        },
    },
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
    ensure!(nix::unistd::geteuid().is_root(), "robots' places and servants are made by root: sudo make eval");
    let target = arguments.target.clone().unwrap_or_else(|| {
        let name = if arguments.quick { "eval-quick" } else { "eval" };
        bench_report::root().join("target").join(name)
    });
    let cells = RunCache::new(target.join("cells"), arguments.fresh)?;
    let cells = cells.with_basis(basis::basis()?);
    interrupt::listen()?;
    for line in sweep::remove_all() {
        eprintln!("left by an evaluation before: {line}");
    }
    let place = tempfile::Builder::new().prefix(sweep::PREFIX).tempdir()?;
    claim::claim(place.path())?;
    let daemon = DaemonSetup::new(&place.path().join("home")).start()?;
    let workshop = EvalFixtures::new(&daemon, place.path());
    let sections = match &arguments.verb {
        Some(EvalCommand::Rehearse { seconds }) => {
            vec![rehearsal::section(&cells, &workshop, *seconds)?]
        }
        _ => {
            let directory = workshop.directory()?;
            let evaluation = Evaluation {
                cells: &cells,
                workshop: &workshop,
                crowd: CrowdDaemon::new(directory.path()),
                quick: arguments.quick,
            };
            run_experiments(arguments, evaluation)
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
    let is_wanted = |number: &u8| arguments.only.is_empty() || arguments.only.contains(number);
    let is_omitted = |one: &Experiment| quick && arguments.only.is_empty() && one.left_out.is_some();
    let wanted = EXPERIMENTS.iter().filter(|one| one.numbers.iter().any(is_wanted));
    let (omitted, wanted): (Vec<&Experiment>, Vec<_>) = wanted.partition(|one| is_omitted(one));
    let seconds = wanted.iter().map(|one| one.seconds[usize::from(!quick)]);
    eprintln!(
        "this takes about {} min on a machine of two cores, less what was measured before; packages that were never \
         compiled take some minutes more",
        seconds.sum::<u32>().div_ceil(60)
    );
    eprintln!("min:s  run");
    let mut sections = Vec::new();
    for one in wanted {
        match (one.run)(&mut evaluation) {
            Ok(made) => sections.extend(made.into_iter().filter(|made| is_wanted(&made.number))),
            Err(error) => {
                let numbers = one.numbers.iter().copied().filter(is_wanted);
                sections.extend(numbers.take(1).map(|number| failure_section(number, &error)));
            }
        }
    }
    for one in omitted {
        if let Some([id, title, covered]) = one.left_out {
            let mut section = Section::new(one.numbers[0], id, title);
            section.findings.push(format!(
                "A quick evaluation leaves this out: {covered} run the same of the programs. make eval measures it."
            ));
            sections.push(section);
        }
    }
    sections.sort_by_key(|section| section.number);
    sections
}

/// Creates the section of an experiment that failed as a whole.
fn failure_section(number: u8, error: &anyhow::Error) -> Section {
    let title = format!("Experiment {number}");
    let mut section = Section::new(number, format!("failed-{number}"), title);
    let why = format!("{error:#}");
    section.missing.push(MissingMeasurement::retryable("the whole experiment", why));
    section
}
