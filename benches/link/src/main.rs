//! `make bench ONLY=link`: a robot's node through stub, link, daemon and servant, compared in turns with the same node
//! on the robot and with a client of the portal; and the memory and processor time of a stub. Needs root.
//! `CLOUDROID_BENCH_FULL=1` measures longer; the argument `strings` runs that part alone.

#![forbid(unsafe_code)]

mod people;
mod strings;

use anyhow::{Result, bail};
use bench_report::{BenchDaemon, BenchReport};
use support::world::{FIXTURE, PEOPLE};

fn main() -> Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    match words.as_slice() {
        [] => measure(true),
        ["strings"] => measure(false),
        _ => bail!("it takes the word strings, or nothing; CLOUDROID_BENCH_FULL=1 measures longer"),
    }
}

/// Measures the round trip of a String and, with `all`, all other figures.
fn measure(all: bool) -> Result<()> {
    let daemon = BenchDaemon::start("")?;
    eprintln!("pushing people_detect and a relay: what they need is made now, if it is not cached");
    let deployer = daemon.deployer();
    if all {
        deployer.run(&[&["push"], PEOPLE.arguments].concat())?.expect_success()?;
    }
    let relay = ["--name", "meter", "--node", "rosbridge_fixture/meter"];
    deployer.push(FIXTURE.package.unwrap_or_default(), &relay)?.expect_success()?;
    let mut report = BenchReport::new("link");
    if all {
        people::measure(&mut report, &daemon)?;
    }
    strings::measure(&mut report, &daemon)?;
    report.finish()?;
    Ok(())
}
