//! Idle connections.

use std::time::{Duration, Instant};

use anyhow::Result;
use bench_report::{BenchReport, Target};
use support::daemon::Daemon;

use crate::crowd::IdleCrowd;
use crate::greeters::{self, SILENCE};
use crate::milliseconds::quantile;
use crate::resources::Resources;

/// Number of idle connections.
const IDLE: usize = 1000;
/// Interval between the calls of another robot.
const PACE: Duration = Duration::from_millis(50);

/// Results with a thousand idle connections.
#[derive(Debug)]
pub(super) struct IdleResult {
    answered: usize,
    /// Memory of the daemon per connection, in kilobytes.
    kilobytes: f64,
    /// Durations of another robot's calls without the idle connections and with them.
    alone: Vec<Duration>,
    beside: Vec<Duration>,
}

pub(super) fn measure(daemon: &Daemon) -> Result<IdleResult> {
    let alone = time_calls(daemon, SILENCE / 2)?;
    let before = Resources::read(daemon.pid())?;
    let crowd = IdleCrowd::connect(&daemon.url(&greeters::robot_path("crowd")), IDLE)?;
    // Longer than the time after which clients that answer no pings are disconnected.
    let beside = time_calls(daemon, SILENCE * 3 / 2)?;
    let grown = Resources::read(daemon.pid())?.anonymous - before.anonymous;
    Ok(IdleResult {
        answered: crowd.ask_and_leave()?,
        kilobytes: grown * 1e3 / IDLE as f64,
        alone,
        beside,
    })
}

impl IdleResult {
    pub(super) fn add_figures(&self, report: &mut BenchReport) {
        report
            .figure(
                format!("idle WebSockets of {IDLE} that are answered"),
                "",
                self.answered as f64,
            )
            .require(Target::AtLeast(IDLE as f64))
            .note(format!(
                "after {:?}; {:.0} kB of the daemon's memory for each",
                SILENCE * 3 / 2,
                self.kilobytes
            ));
        report
            .figure(
                format!("a call beside {IDLE} idle WebSockets, p99"),
                "ms",
                quantile(&self.beside, 0.99),
            )
            .relative_to("without them", quantile(&self.alone, 0.99))
            .require(Target::RatioAtMost(2.0))
            .note(format!(
                "p50 {:.2} ms beside {:.2} ms",
                quantile(&self.beside, 0.5),
                quantile(&self.alone, 0.5)
            ));
    }
}

/// Calls as another robot for `time`; returns the duration of each call.
fn time_calls(daemon: &Daemon, time: Duration) -> Result<Vec<Duration>> {
    let mut robot = daemon.robot(&greeters::robot_path("polite"))?;
    greeters::greeting_count(&mut robot)?;
    let (began, mut times) = (Instant::now(), Vec::new());
    while began.elapsed() < time {
        let asked = Instant::now();
        greeters::greeting_count(&mut robot)?;
        times.push(asked.elapsed());
        std::thread::sleep(PACE);
    }
    Ok(times)
}
