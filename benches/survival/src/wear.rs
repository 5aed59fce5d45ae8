//! Repeated failures and load on one daemon, in two passes: the resources after the second must not exceed those after
//! the first. They may grow in the first, because that is when one-time allocations are made and buffers reach the size
//! that they ever need.

use anyhow::Result;
use bench_report::BenchReport;
use support::daemon::Daemon;

use crate::kills::{self, Victim};
use crate::resources::Resources;
use crate::{crowds, half_open};

/// Makes both passes, the second with `kills` kills of each kind; kinds that take longer are limited to `few`.
pub(crate) fn measure(report: &mut BenchReport, daemon: &Daemon, kills: u32, few: u32) -> Result<()> {
    // The figures of the first pass are nobody's.
    make_pass(&mut BenchReport::new("first"), daemon, few, few)?;
    let before = Resources::read_at_rest(daemon)?;
    make_pass(report, daemon, kills, few)?;
    let after = Resources::read_at_rest(daemon)?;
    let before = ("after the first time", before);
    after.add_figures(report, "all this a second time", before);
    Ok(())
}

fn make_pass(report: &mut BenchReport, daemon: &Daemon, kills: u32, few: u32) -> Result<()> {
    print_resources(daemon, "before")?;
    for victim in Victim::ALL {
        kills::kill_in_servants(report, daemon, victim, kills)?;
        print_resources(daemon, &format!("{kills} kills of a servant's {victim}"))?;
    }
    crowds::measure(report, daemon)?;
    print_resources(daemon, "crowds")?;
    half_open::measure(report, daemon, few)?;
    print_resources(daemon, "half-open connections")
}

/// Prints the resources, to show which part made them grow.
fn print_resources(daemon: &Daemon, after: &str) -> Result<()> {
    eprintln!("{after}: {:?}", Resources::read(daemon)?);
    Ok(())
}
