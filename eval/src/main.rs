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
use eval::section::Section;
use eval::{estimate, examples, interrupt, rehearsal, report, robot, sweep};

/// Requests of each run of a quick evaluation.
const QUICK: usize = 10;

/// The published experiments on this machine: target/eval/report.html.
#[derive(Debug, Parser)]
struct Arguments {
    /// Only what takes some minutes: few requests of each run, no benchmarks.
    #[arg(long)]
    quick: bool,
    /// Only the experiments of these numbers.
    #[arg(long, value_delimiter = ',', value_name = "NUMBERS")]
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
    let cells = cells.based_on(examples::fingerprint()?);
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
            estimate::tell(arguments.quick, &arguments.only);
            sections(arguments, &cells, &workshop)?
        }
    };
    daemon.ends()?;
    report::write(&target, &sections)
}

fn sections(arguments: &Arguments, cells: &Cells, workshop: &Workshop) -> Result<Vec<Section>> {
    let wanted = |number: u8| arguments.only.is_empty() || arguments.only.contains(&number);
    let most = arguments.quick.then_some(QUICK);
    let mut sections = Vec::new();
    if wanted(1) {
        sections.push(transparency::section(&transparency::measure(
            cells, workshop, most,
        )?));
    }
    if [2, 4, 5].into_iter().any(wanted) {
        let runs = outsourcing::measure(cells, workshop, most)?;
        let made = [
            outsourcing::response_times(&runs)?,
            outsourcing::phases(&runs)?,
            outsourcing::jitter(&runs)?,
        ];
        sections.extend(made.into_iter().filter(|section| wanted(section.number)));
    }
    if wanted(2) {
        let studies = cores::measure(cells, workshop, arguments.quick)?;
        sections.push(cores::section(&studies)?);
    }
    if wanted(3) {
        sections.push(memory::section(&memory::measure(cells, workshop)?));
    }
    if wanted(6) {
        let runs = failover::measure(cells, workshop, arguments.quick)?;
        sections.push(failover::section(&runs)?);
    }
    if wanted(7) {
        sections.push(map::section(&map::measure(
            cells,
            workshop,
            most.map(|most| most * 3),
        )?)?);
    }
    if wanted(8) {
        let runs = codecs::measure(cells, workshop, arguments.quick)?;
        sections.push(codecs::section(&runs)?);
    }
    if [9, 10].into_iter().any(wanted) {
        let place = workshop.directory()?;
        let mut yard = Yard::new(place.path());
        if wanted(9) {
            let runs = neighbours::measure(cells, &mut yard, arguments.quick)?;
            sections.push(neighbours::section(&runs)?);
        }
        if wanted(10) {
            let runs = scale::measure(cells, &mut yard, arguments.quick)?;
            sections.push(scale::section(&runs)?);
        }
    }
    if arguments.quick && wanted(11) {
        sections.push(later(11, "overhead", "What the system itself adds"));
    }
    if !arguments.quick && wanted(11) {
        sections.push(overhead::section(&overhead::measure(cells)?)?);
    }
    sections.sort_by_key(|section| section.number);
    Ok(sections)
}

/// An experiment that a quick evaluation leaves out.
fn later(number: u8, id: &str, title: &str) -> Section {
    let mut section = Section::new(number, id, title);
    section
        .findings
        .push("A quick evaluation leaves this out; make eval measures it.".to_owned());
    section
}
