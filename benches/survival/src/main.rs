//! `make bench ONLY=survival`: what a daemon and its robots live through. Needs root.
//!
//! ```text
//!  daemons    kill -9 of the daemon under traffic: servants that are lost, time until the next one answers
//!  upgrade    26 servants at work, and the daemon replaced: servants that are lost, the longest gap a robot sees
//!  wear       one daemon: kill -9 of shims, inits and nodes, crowds, half-open connections, all of it twice; what its process holds
//!             after the second time beside the first
//!  soak       the same daemon: mixed load by 20 robots, for three minutes or what CLOUDROID_BENCH_SOAK says (1h); what its process holds
//!  disk       a full disk: robots at work, robots that are new, changes that were confirmed
//! ```
//! One of these words as an argument runs that part alone. `CLOUDROID_BENCH_ROUNDS` says how often each is killed.

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
use bench_report::Report;
/// How often each is killed.
const ROUNDS: u32 = 50;
/// Of that, how often where it takes longer, at most.
const FEW: u32 = 5;

/// In the directory of this run.
const HOME: &str = "home";

const PARTS: [&str; 5] = ["daemons", "upgrade", "wear", "soak", "disk"];

fn main() -> Result<()> {
    // While there is one thread: whatever is mounted from here on is gone when this program is, however it ends.
    support::disk::enter_namespace()?;
    let words: Vec<String> = std::env::args().skip(1).collect();
    let parts: Vec<&str> = match words.as_slice() {
        [] => PARTS.to_vec(),
        [word] if PARTS.contains(&word.as_str()) => vec![word],
        _ => bail!(
            "it takes nothing, or one of these words: {}",
            PARTS.join(", ")
        ),
    };
    let rounds = match std::env::var("CLOUDROID_BENCH_ROUNDS") {
        Ok(rounds) => rounds.parse().context("CLOUDROID_BENCH_ROUNDS")?,
        Err(_) => ROUNDS,
    };
    let place = tempfile::Builder::new()
        .prefix("cloudroid-bench-")
        .tempdir()?;
    let mut report = Report::new("survival");
    let measured = measure(&mut report, place.path(), &parts, rounds);
    greeters::end_left(&place.path().join(HOME))?;
    measured?;
    report.finish()?;
    Ok(())
}

fn measure(report: &mut Report, place: &Path, parts: &[&str], rounds: u32) -> Result<()> {
    let time = soak::duration()?;
    let few = rounds.min(FEW);
    let setup = greeters::publish(&place.join(HOME))?;
    if parts.contains(&"daemons") {
        kills::of_daemons(report, &setup, rounds)?;
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
        daemon.ends()?;
    }
    if parts.contains(&"disk") {
        disk::measure(report, place, few)?;
    }
    Ok(())
}
