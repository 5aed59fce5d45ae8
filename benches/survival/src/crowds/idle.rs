//! Connections that say nothing.

use std::time::{Duration, Instant};

use anyhow::Result;
use bench_report::{Report, Target};
use support::daemon::Daemon;

use crate::crowd::Crowd;
use crate::greeters::{self, SILENCE};
use crate::milliseconds::part;
use crate::resources::Resources;

/// So many.
const IDLE: usize = 1000;
/// Between another robot's calls.
const PACE: Duration = Duration::from_millis(50);

/// A thousand that say nothing.
#[derive(Debug)]
pub(super) struct Idle {
    answered: usize,
    /// Kilobytes of the daemon's memory for each.
    kilobytes: f64,
    /// Times of another robot's calls without them and beside them.
    alone: Vec<Duration>,
    beside: Vec<Duration>,
}

pub(super) fn measure(daemon: &Daemon) -> Result<Idle> {
    let alone = call_for(daemon, SILENCE / 2)?;
    let before = Resources::of(daemon.pid())?;
    let crowd = Crowd::connect(&daemon.url(&greeters::path("crowd")), IDLE)?;
    // Longer than who answers no pings is let stay.
    let beside = call_for(daemon, SILENCE * 3 / 2)?;
    let grown = Resources::of(daemon.pid())?.anonymous - before.anonymous;
    Ok(Idle {
        answered: crowd.ask()?,
        kilobytes: grown * 1e3 / IDLE as f64,
        alone,
        beside,
    })
}

impl Idle {
    pub(super) fn tell(&self, report: &mut Report) {
        report
            .figure(
                format!("idle WebSockets of {IDLE} that are answered"),
                "",
                self.answered as f64,
            )
            .reach(Target::AtLeast(IDLE as f64))
            .note(format!(
                "after {:?}; {:.0} kB of the daemon's memory for each",
                SILENCE * 3 / 2,
                self.kilobytes
            ));
        report
            .figure(
                format!("a call beside {IDLE} idle WebSockets, p99"),
                "ms",
                part(&self.beside, 0.99),
            )
            .beside("without them", part(&self.alone, 0.99))
            .reach(Target::RatioAtMost(2.0))
            .note(format!(
                "p50 {:.2} ms beside {:.2} ms",
                part(&self.beside, 0.5),
                part(&self.alone, 0.5)
            ));
    }
}

/// Calls as another robot again and again for a while; returns how long each took.
fn call_for(daemon: &Daemon, time: Duration) -> Result<Vec<Duration>> {
    let mut robot = daemon.robot(&greeters::path("polite"))?;
    greeters::count(&mut robot)?;
    let (began, mut times) = (Instant::now(), Vec::new());
    while began.elapsed() < time {
        let asked = Instant::now();
        greeters::count(&mut robot)?;
        times.push(asked.elapsed());
        std::thread::sleep(PACE);
    }
    Ok(times)
}
