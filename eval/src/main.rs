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
use eval::{report, robot};

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
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let done = match &arguments.verb {
        Some(Verb::Robot { order, answer }) => robot::main(order, answer).map(|()| true),
        None => evaluate(&arguments),
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
    let target = bench_report::root()
        .join("target")
        .join(if arguments.quick {
            "eval-quick"
        } else {
            "eval"
        });
    let cells = Cells::new(target.join("cells"), arguments.fresh)?;
    let place = tempfile::Builder::new()
        .prefix("cloudroid-eval-")
        .tempdir()?;
    let daemon = Setup::new(&place.path().join("home")).start()?;
    let workshop = Workshop::new(&daemon, place.path());
    let sections = sections(arguments, &cells, &workshop)?;
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
    if !arguments.quick && wanted(11) {
        sections.push(overhead::section(&overhead::measure(cells)?)?);
    }
    sections.sort_by_key(|section| section.number);
    Ok(sections)
}
