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

pub(super) fn measure(report: &mut BenchReport, daemon: &Daemon) -> Result<()> {
    let alone = time_calls(daemon, SILENCE / 2)?;
    let before = Resources::read(daemon)?;
    let crowd = IdleCrowd::connect(&daemon.url(&greeters::robot_path("crowd")), IDLE)?;
    // Longer than the time after which clients that answer no pings are disconnected.
    let time = SILENCE * 3 / 2;
    let beside = time_calls(daemon, time)?;
    let grown = Resources::read(daemon)?.anonymous - before.anonymous;
    let answered = crowd.ask_and_leave()?;
    let title = format!("idle WebSockets of {IDLE} that are answered");
    report
        .figure(title, "", answered as f64)
        .require(Target::AtLeast(IDLE as f64))
        .note(format!("after {time:?}; {:.0} kB of the daemon's memory for each", grown * 1e3 / IDLE as f64));
    let title = format!("a call beside {IDLE} idle WebSockets, p99");
    report
        .figure(title, "ms", quantile(&beside, 0.99))
        .relative_to("without them", quantile(&alone, 0.99))
        .require(Target::RatioAtMost(2.0))
        .note(format!("p50 {:.2} ms beside {:.2} ms", quantile(&beside, 0.5), quantile(&alone, 0.5)));
    Ok(())
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
