//! Many connections: robots that come and go, a thousand that say nothing, and a hundred that never read what is published.

mod coming;
mod idle;
mod unread;

use anyhow::{Context, Result, anyhow};
use bench_report::Report;
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use support::daemon::Daemon;

use crate::greeters;

/// What came of all of it.
#[derive(Debug)]
pub(crate) struct Crowds {
    coming: coming::Coming,
    idle: idle::Idle,
    unread: unread::Unread,
}

/// Does all of it to one daemon.
pub(crate) fn measure(daemon: &Daemon) -> Result<Crowds> {
    allow_many_descriptors()?;
    for robot in ["crowd", "polite"] {
        greeters::ask_again(daemon, robot)?;
    }
    let crowds = Crowds {
        coming: coming::measure(daemon)?,
        idle: idle::measure(daemon)?,
        unread: unread::measure(daemon)?,
    };
    greeters::stop_all(daemon)?;
    Ok(crowds)
}

impl Crowds {
    /// Adds their figures.
    pub(crate) fn tell(&self, report: &mut Report) {
        self.coming.tell(report);
        self.idle.tell(report);
        self.unread.tell(report);
    }
}

/// The daemon under test was started with fewer, as it is by a service manager.
fn allow_many_descriptors() -> Result<()> {
    let (_, most) = getrlimit(Resource::RLIMIT_NOFILE)?;
    setrlimit(Resource::RLIMIT_NOFILE, most, most).context("more descriptors for this program")
}

/// Waits for a thread.
fn joined<T>(thread: std::thread::ScopedJoinHandle<'_, Result<T>>) -> Result<T> {
    thread.join().map_err(|_| anyhow!("a robot panicked"))?
}
