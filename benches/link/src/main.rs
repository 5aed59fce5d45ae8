//! `make bench ONLY=link`: a robot's node through stub, link, daemon and servant, compared in turns with the same node
//! on the robot and with a client of the portal; and the memory and processor time of a stub. Needs root.
//! `CLOUDROID_BENCH_FULL=1` measures longer; the argument `strings` runs that part alone.

#![forbid(unsafe_code)]

mod beside;
mod idle;
mod people;
mod strings;

use anyhow::{Result, bail};
use bench_report::BenchReport;
use support::daemon::DaemonSetup;
use support::world::{FIXTURE, PEOPLE};

/// Returns whether longer measurements are requested (`CLOUDROID_BENCH_FULL=1`).
fn is_full_run() -> bool {
    std::env::var_os("CLOUDROID_BENCH_FULL").is_some_and(|value| value == "1")
}

fn main() -> Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    match words
        .iter()
        .map(String::as_str)
        .collect::<Vec<_>>()
        .as_slice()
    {
        [] => measure(true),
        ["strings"] => measure(false),
        _ => bail!("it takes the word strings, or nothing; CLOUDROID_BENCH_FULL=1 measures longer"),
    }
}

/// Measures the round trip of a String and, with `all`, all other figures.
fn measure(all: bool) -> Result<()> {
    let place = tempfile::Builder::new()
        .prefix("cloudroid-bench-")
        .tempdir()?;
    let daemon = DaemonSetup::new(&place.path().join("home")).start()?;
    eprintln!("pushing people_detect and a relay: what they need is made now, if it is not cached");
    let deployer = daemon.deployer();
    if all {
        deployer
            .run(&[&["push"], PEOPLE.arguments].concat())?
            .expect_success()?;
    }
    let relay = ["--name", "meter", "--node", "rosbridge_fixture/meter"];
    deployer
        .push(FIXTURE.package.unwrap_or_default(), &relay)?
        .expect_success()?;
    let mut report = BenchReport::new("link");
    if all {
        people::measure(&mut report, &daemon)?;
    }
    strings::measure(&mut report, &daemon)?;
    if all {
        beside::measure(&mut report, &daemon)?;
    }
    report.finish()?;
    daemon
        .deployer()
        .run(&["stop", "--all"])?
        .expect_success()?;
    daemon.stop()?;
    Ok(())
}

/// Median in seconds; NaN for an empty slice.
fn median_seconds(times: &[std::time::Duration]) -> f64 {
    bench_report::quantile(times, 0.5).map_or(f64::NAN, |time| time.as_secs_f64())
}
