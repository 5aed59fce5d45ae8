//! Repeated failures and load on one daemon, in two passes: the resources after the second must not exceed those after
//! the first. They may grow in the first, because that is when one-time allocations are made and buffers reach the size
//! that they ever need.

use anyhow::Result;
use bench_report::BenchReport;
use support::daemon::Daemon;

use crate::crowds::{self, CrowdResults};
use crate::half_open::{self, HalfOpenResult};
use crate::kills::{self, KillResult, Victim};
use crate::resources::Resources;

/// Results of one pass.
struct WearRun {
    kills: Vec<KillResult>,
    crowds: CrowdResults,
    half_open: HalfOpenResult,
}

/// Makes both passes, the second with `kills` kills of each kind; kinds that take longer are limited to `few`.
pub(crate) fn measure(
    report: &mut BenchReport,
    daemon: &Daemon,
    kills: u32,
    few: u32,
) -> Result<()> {
    WearRun::run(daemon, few, few)?;
    let before = Resources::read_at_rest(daemon.pid())?;
    let wear = WearRun::run(daemon, kills, few)?;
    let after = Resources::read_at_rest(daemon.pid())?;
    for kills in &wear.kills {
        kills.add_figures(report);
    }
    wear.crowds.add_figures(report);
    wear.half_open.add_figures(report);
    after.add_figures(
        report,
        "all this a second time",
        ("after the first time", before),
    );
    Ok(())
}

impl WearRun {
    fn run(daemon: &Daemon, kills: u32, few: u32) -> Result<Self> {
        print_resources(daemon, "before")?;
        let mut all = Vec::new();
        for victim in Victim::ALL {
            all.push(kills::kill_in_servants(daemon, victim, kills)?);
            print_resources(daemon, &format!("{kills} kills of a servant's {victim}"))?;
        }
        let crowds = crowds::measure(daemon)?;
        print_resources(daemon, "crowds")?;
        let half_open = half_open::measure(daemon, few)?;
        print_resources(daemon, "half-open connections")?;
        Ok(Self {
            kills: all,
            crowds,
            half_open,
        })
    }
}

/// Prints the resources, to show which part made them grow.
fn print_resources(daemon: &Daemon, after: &str) -> Result<()> {
    eprintln!("{after}: {:?}", Resources::read(daemon.pid())?);
    Ok(())
}
