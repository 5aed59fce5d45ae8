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

/// Runs all parts against one daemon.
pub(crate) fn measure(report: &mut BenchReport, daemon: &Daemon) -> Result<()> {
    raise_descriptor_limit()?;
    for robot in ["crowd", "polite"] {
        greeters::ask_until_answered(daemon, robot)?;
    }
    coming::measure(report, daemon)?;
    idle::measure(report, daemon)?;
    unread::measure(report, daemon)?;
    greeters::stop_all(daemon)
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
