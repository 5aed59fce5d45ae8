//! `make bench ONLY=link`: a robot's node through stub, link, daemon and servant, beside the same node on the robot and
//! beside a client of the portal, in turns; and what a stub takes of memory and processor. Needs root.
//! `CLOUDROID_BENCH_FULL=1` measures longer; the word `strings` as an argument
//! runs that part alone.

#![forbid(unsafe_code)]

mod beside;
mod idle;
mod people;
mod strings;

use anyhow::{Result, bail};
use bench_report::Report;
use support::daemon::Setup;
use support::world::{FIXTURE, PEOPLE};

/// Longer measurements are wanted.
fn full() -> bool {
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

/// A String's way there and back; and `all` others.
fn measure(all: bool) -> Result<()> {
    let place = tempfile::Builder::new()
        .prefix("cloudroid-bench-")
        .tempdir()?;
    let daemon = Setup::new(&place.path().join("home")).start()?;
    eprintln!("pushing people_detect and a relay: what they need is made now, if it is not cached");
    let deployer = daemon.deployer();
    if all {
        deployer
            .types(&[&["push"], PEOPLE.arguments].concat())?
            .succeeded()?;
    }
    let relay = ["--name", "meter", "--node", "rosbridge_fixture/meter"];
    deployer
        .pushes(FIXTURE.package.unwrap_or_default(), &relay)?
        .succeeded()?;
    let mut report = Report::new("link");
    if all {
        people::measure(&mut report, &daemon)?;
    }
    strings::measure(&mut report, &daemon)?;
    if all {
        beside::measure(&mut report, &daemon)?;
    }
    report.finish()?;
    daemon.deployer().types(&["stop", "--all"])?.succeeded()?;
    daemon.ends()?;
    Ok(())
}

/// In seconds.
fn median(times: &[std::time::Duration]) -> f64 {
    bench_report::quantile(times, 0.5).map_or(f64::NAN, |time| time.as_secs_f64())
}
