//! An upgrade: the daemon is stopped and another one started in its place while many robots work. Their connections
//! end; their servants do not.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Result, anyhow};
use bench_report::{BenchReport, Target};
use support::daemon::DaemonSetup;
use support::robot::Robot;

use crate::greeters;
use crate::milliseconds::{median, worst};

/// Number of working servants.
const SERVANTS: usize = 26;
/// Interval between a robot's calls.
const PACE: Duration = Duration::from_millis(100);

/// Replaces the daemon `rounds` times.
pub(crate) fn measure(report: &mut BenchReport, setup: &DaemonSetup, rounds: u32) -> Result<()> {
    let mut alone = Vec::new();
    for _ in 0..rounds {
        let daemon = setup.start()?;
        let began = Instant::now();
        daemon.stop()?;
        let (daemon, _) = greeters::start(setup)?;
        alone.push(began.elapsed());
        daemon.stop()?;
    }
    let mut daemon = setup.start()?;
    let robots: Vec<String> = (0..SERVANTS).map(|number| format!("upgraded-{number}")).collect();
    for robot in &robots {
        greeters::greet(&mut daemon.robot(&greeters::robot_path(robot))?)?;
    }
    let before = greeters::servant_identities(&daemon, &robots)?;
    let (mut lost, mut forgotten, mut gaps) = (0, 0, Vec::new());
    for _ in 0..rounds {
        let address = daemon.address.clone();
        let over = AtomicBool::new(false);
        daemon = std::thread::scope(|scope| -> Result<_> {
            let work = |robot: &String| {
                let (url, over) = (format!("ws://{address}/{}", greeters::robot_path(robot)), &over);
                scope.spawn(move || work_until(&url, over))
            };
            let at_work: Vec<_> = robots.iter().map(work).collect();
            let next = (|| {
                daemon.stop()?;
                let (next, _) = greeters::start(setup)?;
                for robot in &robots {
                    // Every robot had one name greeted before.
                    forgotten += u32::from(greeters::ask_until_answered(&next, robot)? < 1);
                }
                Ok(next)
            })();
            over.store(true, Ordering::Relaxed);
            for robot in at_work {
                gaps.push(robot.join().map_err(|_| anyhow!("a robot panicked"))?);
            }
            next
        })?;
        lost += greeters::count_lost(&before, &greeters::servant_identities(&daemon, &robots));
    }
    greeters::stop_all(&daemon)?;
    daemon.stop()?;
    let title = format!("{rounds} upgrades with {SERVANTS} servants at work, servants lost");
    report.figure(title, "", lost as f64).require(Target::AtMost(0.0));
    let title = "nodes that had forgotten what they knew by then";
    report.figure(title, "", f64::from(forgotten)).require(Target::AtMost(0.0));
    let title = "longest time between two answers to a robot";
    report
        .figure(title, "ms", median(&gaps))
        .relative_to("end and start of a daemon with no servants", median(&alone))
        .note(format!("medians; at worst {:.0} ms beside {:.0} ms", worst(&gaps), worst(&alone)));
    Ok(())
}

/// Calls a servant repeatedly, reconnecting if necessary, until `over` is set; returns the longest time between two
/// answers.
fn work_until(url: &str, over: &AtomicBool) -> Duration {
    let (mut longest, mut answered) = (Duration::ZERO, Instant::now());
    let mut connection = None;
    loop {
        // Read before the call, so that a gap which is still open at the end is counted.
        let is_last = over.load(Ordering::Relaxed);
        if connection.is_none() {
            connection = Robot::connect(url).ok();
        }
        if connection.as_mut().is_some_and(|robot| greeters::greeting_count(robot).is_ok()) {
            longest = longest.max(answered.elapsed());
            answered = Instant::now();
            if is_last {
                return longest;
            }
        } else {
            connection = None;
            if is_last {
                return longest.max(answered.elapsed());
            }
        }
        std::thread::sleep(PACE);
    }
}
