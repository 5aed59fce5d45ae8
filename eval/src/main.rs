//! `make eval`: the published experiments on one machine, with real nodes, and a report of them. Needs root.

#![forbid(unsafe_code)]

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Result, ensure};
use clap::{Parser, Subcommand};
use support::daemon::Setup;

use eval::cells::Cells;
use eval::examples::Workshop;
use eval::experiments::crowd::Yard;
use eval::experiments::{
    codecs, cores, failover, map, memory, neighbours, outsourcing, overhead, scale, transparency,
};
use eval::section::{Missing, Section};
use eval::{basis, estimate, interrupt, rehearsal, report, robot, sweep};

/// Requests of each run of a quick evaluation.
const QUICK: usize = 6;

/// What a quick evaluation leaves out, unless it is named: with its title, and what shows the same of the programs.
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

/// The published experiments on this machine: target/eval/report.html.
#[derive(Debug, Parser)]
struct Arguments {
    /// Only what takes two minutes: what no story shows, with few requests of each run; or what is named.
    #[arg(long)]
    quick: bool,
    /// Only the experiments of these numbers.
    #[arg(long, value_delimiter = ',', value_name = "NUMBERS", value_parser = clap::value_parser!(u8).range(1..=11))]
    only: Vec<u8>,
    /// Measure again what was measured before.
    #[arg(long)]
    fresh: bool,
    /// Where the report is written, and what was measured is kept; without it below the checkout's `target`.
    #[arg(long, global = true, value_name = "DIRECTORY")]
    target: Option<PathBuf>,
    #[command(subcommand)]
    verb: Option<Verb>,
}

#[derive(Debug, Subcommand)]
enum Verb {
    /// What runs in a robot's place.
    #[command(hide = true)]
    Robot {
        /// Its plan.
        order: PathBuf,
        /// Where what it saw is written.
        answer: PathBuf,
    },
    /// An evaluation of nothing, for tests.
    #[command(hide = true)]
    Rehearse {
        /// How long its node is there.
        seconds: f64,
    },
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let done = match &arguments.verb {
        Some(Verb::Robot { order, answer }) => robot::main(order, answer).map(|()| true),
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

/// Whether all was measured.
fn evaluate(arguments: &Arguments) -> Result<bool> {
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
    let cells = Cells::new(target.join("cells"), arguments.fresh)?;
    let cells = cells.based_on(basis::basis()?);
    interrupt::listen()?;
    for line in sweep::all() {
        eprintln!("left by an evaluation before: {line}");
    }
    let place = tempfile::Builder::new().prefix(sweep::PREFIX).tempdir()?;
    sweep::claim(place.path())?;
    let daemon = Setup::new(&place.path().join("home")).start()?;
    let workshop = Workshop::new(&daemon, place.path());
    let sections = match &arguments.verb {
        Some(Verb::Rehearse { seconds }) => {
            vec![rehearsal::section(&cells, &workshop, *seconds)?]
        }
        _ => {
            let numbers = numbers(arguments);
            estimate::tell(arguments.quick, &numbers);
            let mut sections = sections(arguments.quick, &numbers, &cells, &workshop);
            if arguments.only.is_empty() {
                sections.extend(left_out(&numbers));
                sections.sort_by_key(|section| section.number);
            }
            sections
        }
    };
    // Before the daemon's end: whatever becomes of that, what was measured is told.
    let complete = report::write(&target, &sections, &cells)?;
    daemon.ends()?;
    Ok(complete)
}

/// The experiments that are asked for.
fn numbers(arguments: &Arguments) -> Vec<u8> {
    if !arguments.only.is_empty() {
        return arguments.only.clone();
    }
    let shown = |number: &u8| LEFT_OUT.iter().any(|(one, ..)| one == number);
    (1..=11)
        .filter(|number| !arguments.quick || !shown(number))
        .collect()
}

fn sections(quick: bool, numbers: &[u8], cells: &Cells, workshop: &Workshop) -> Vec<Section> {
    let wanted = |number: u8| numbers.contains(&number);
    let most = quick.then_some(QUICK);
    let mut sections = Vec::new();
    if wanted(1) {
        sections.extend(attempt(1, || {
            let runs = transparency::measure(cells, workshop, most)?;
            Ok(vec![transparency::section(&runs)])
        }));
    }
    if [2, 4, 5].into_iter().any(wanted) {
        sections.extend(attempt(2, || {
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
        sections.extend(attempt(2, || {
            let studies = cores::measure(cells, workshop, quick)?;
            Ok(vec![cores::section(&studies)?])
        }));
    }
    if wanted(3) {
        sections.extend(attempt(3, || {
            let runs = memory::measure(cells, workshop)?;
            Ok(vec![memory::section(&runs)])
        }));
    }
    if wanted(6) {
        sections.extend(attempt(6, || {
            let runs = failover::measure(cells, workshop, quick)?;
            Ok(vec![failover::section(&runs)?])
        }));
    }
    if wanted(7) {
        sections.extend(attempt(7, || {
            let runs = map::measure(cells, workshop, most.map(|most| most * 5))?;
            Ok(vec![map::section(&runs)?])
        }));
    }
    if wanted(8) {
        sections.extend(attempt(8, || {
            let runs = codecs::measure(cells, workshop, quick)?;
            Ok(vec![codecs::section(&runs)?])
        }));
    }
    if [9, 10].into_iter().any(wanted) {
        match workshop.directory() {
            Ok(place) => {
                let mut yard = Yard::new(place.path());
                if wanted(9) {
                    sections.extend(attempt(9, || {
                        let runs = neighbours::measure(cells, &mut yard, quick)?;
                        Ok(vec![neighbours::section(&runs)?])
                    }));
                }
                if wanted(10) {
                    sections.extend(attempt(10, || {
                        let runs = scale::measure(cells, &mut yard, quick)?;
                        Ok(vec![scale::section(&runs)?])
                    }));
                }
            }
            Err(error) => sections.push(failed(9, &error)),
        }
    }
    if wanted(11) {
        sections.extend(attempt(11, || {
            let runs = overhead::measure(cells)?;
            Ok(vec![overhead::section(&runs)?])
        }));
    }
    sections.sort_by_key(|section| section.number);
    sections
}

/// What the report shows of an experiment, or why there is nothing: one that fails as a whole does not stop the others.
fn attempt(number: u8, made: impl FnOnce() -> Result<Vec<Section>>) -> Vec<Section> {
    made().unwrap_or_else(|error| vec![failed(number, &error)])
}

/// An experiment that failed as a whole.
fn failed(number: u8, error: &anyhow::Error) -> Section {
    let title = format!("Experiment {number}");
    let mut section = Section::new(number, format!("failed-{number}"), title);
    let why = format!("{error:#}");
    section
        .missing
        .push(Missing::again("the whole experiment", why));
    section
}

/// What the report says of experiments that are not among these.
fn left_out(numbers: &[u8]) -> Vec<Section> {
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
