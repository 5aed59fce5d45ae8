//! Many connections: robots that come and go, a thousand that send nothing, and a hundred that never read what is
//! published.

mod coming;
mod idle;
mod unread;

use anyhow::{Context, Result, anyhow};
use bench_report::BenchReport;
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use support::daemon::Daemon;

use crate::greeters;

/// Results of all parts.
#[derive(Debug)]
pub(crate) struct CrowdResults {
    coming: coming::ConnectResult,
    idle: idle::IdleResult,
    unread: unread::UnreadResult,
}

/// Runs all parts against one daemon.
pub(crate) fn measure(daemon: &Daemon) -> Result<CrowdResults> {
    raise_descriptor_limit()?;
    for robot in ["crowd", "polite"] {
        greeters::ask_until_answered(daemon, robot)?;
    }
    let crowds = CrowdResults {
        coming: coming::measure(daemon)?,
        idle: idle::measure(daemon)?,
        unread: unread::measure(daemon)?,
    };
    greeters::stop_all(daemon)?;
    Ok(crowds)
}

impl CrowdResults {
    /// Adds the figures to the report.
    pub(crate) fn add_figures(&self, report: &mut BenchReport) {
        self.coming.add_figures(report);
        self.idle.add_figures(report);
        self.unread.add_figures(report);
    }
}

/// Raises the limit of open files for this program. The daemon under test was started with a lower one, as by a service
/// manager.
fn raise_descriptor_limit() -> Result<()> {
    let (_, most) = getrlimit(Resource::RLIMIT_NOFILE)?;
    setrlimit(Resource::RLIMIT_NOFILE, most, most).context("more descriptors for this program")
}

/// Joins a thread and returns its result.
fn join_thread<T>(thread: std::thread::ScopedJoinHandle<'_, Result<T>>) -> Result<T> {
    thread.join().map_err(|_| anyhow!("a robot panicked"))?
}
