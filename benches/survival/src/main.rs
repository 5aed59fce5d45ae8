//! `make bench ONLY=survival`: failures and load that a daemon and its robots survive. Needs root.
//!
//! ```text
//!  daemons    kill -9 of the daemon under load: servants lost, time until the next daemon answers
//!  upgrade    26 working servants while the daemon is replaced: servants lost, longest gap that a robot sees
//!  wear       one daemon, twice: kill -9 of shims, inits and nodes, crowds, half-open connections; resources of its
//!             process after the second time compared with the first
//!  soak       the same daemon: mixed load of 20 robots of both ROS for CLOUDROID_BENCH_SOAK (default: 3m), such as
//!             1h; resources of its process, and the p99 of calls in each sixtieth of the time
//!  disk       a full disk: working robots, new robots, changes that were confirmed
//! ```
//! One of these words as an argument runs that part alone. `CLOUDROID_BENCH_ROUNDS` sets the number of kills of each
//! kind (default: 50).

#![forbid(unsafe_code)]

mod crowd;
mod crowds;
mod disk;
mod greeters;
mod half_open;
mod kills;
mod milliseconds;
mod resources;
mod soak;
mod upgrade;
mod wear;

use std::path::Path;

use anyhow::{Context, Result, bail};
use bench_report::{BenchReport, create_directory};

/// Kills of each kind.
const ROUNDS: u32 = 50;
/// Upper limit of the kills of kinds that take longer.
const FEW: u32 = 5;

/// Name of the home in the directory of this run.
const HOME: &str = "home";

const PARTS: [&str; 5] = ["daemons", "upgrade", "wear", "soak", "disk"];

fn main() -> Result<()> {
    // Before there are threads: mounts made from here on disappear with this program, however it ends.
    support::disk::enter_namespace()?;
    let words: Vec<String> = std::env::args().skip(1).collect();
    let parts: Vec<&str> = match words.as_slice() {
        [] => PARTS.to_vec(),
        [word] if PARTS.contains(&word.as_str()) => vec![word],
        _ => bail!("it takes nothing, or one of these words: {}", PARTS.join(", ")),
    };
    let rounds = match std::env::var("CLOUDROID_BENCH_ROUNDS") {
        Ok(rounds) => rounds.parse().context("CLOUDROID_BENCH_ROUNDS")?,
        Err(_) => ROUNDS,
    };
    let place = create_directory()?;
    let mut report = BenchReport::new("survival");
    let measured = measure(&mut report, place.path(), &parts, rounds);
    greeters::end_leftovers(&place.path().join(HOME))?;
    measured?;
    report.finish()?;
    Ok(())
}

fn measure(report: &mut BenchReport, place: &Path, parts: &[&str], rounds: u32) -> Result<()> {
    let time = soak::duration()?;
    let few = rounds.min(FEW);
    let setup = greeters::publish(&place.join(HOME))?;
    if parts.contains(&"daemons") {
        kills::kill_daemons(report, &setup, rounds)?;
    }
    if parts.contains(&"upgrade") {
        upgrade::measure(report, &setup, few)?;
    }
    if parts.contains(&"wear") || parts.contains(&"soak") {
        let daemon = setup.start()?;
        if parts.contains(&"wear") {
            wear::measure(report, &daemon, rounds, few)?;
        }
        if parts.contains(&"soak") {
            soak::measure(report, &daemon, time)?;
        }
        daemon.stop()?;
    }
    if parts.contains(&"disk") {
        disk::measure(report, place, few)?;
    }
    Ok(())
}
