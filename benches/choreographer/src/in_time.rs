//! How many robots of a machine are answered in time, with limits as they were promised and with the controller. All are promised the
//! same part of the machine. Every other one, beginning with the first, asks again as soon as it is answered, and accepts less than
//! that part gives; the others ask seldom, and accept more.

use std::sync::Barrier;
use std::time::Duration;

use anyhow::{Context, Result};
use bench_report::{Report, Target};
use support::daemon::Daemon;

use crate::worker::{self, WORK, calls, cores, robot};

const ROBOTS: [usize; 7] = [2, 3, 4, 5, 6, 7, 8];
const LASTS: Duration = Duration::from_secs(15);
/// Until the controller has come to rest.
const SETTLES: Duration = Duration::from_secs(15);
/// Part of its requests that must be in time for a robot to count.
const IN_TIME: f64 = 0.95;
const CONFIG: &str = "[servant]\nwarm_pool = 0\nstart = \"5m\"\n";

pub(crate) fn measure(report: &mut Report) -> Result<()> {
    let fixed = counts("off")?;
    let controlled = counts("on")?;
    for ((robots, controlled), fixed) in ROBOTS.iter().zip(&controlled).zip(&fixed) {
        report
            .figure(
                format!("of {robots} robots in time, controller"),
                "robots",
                *controlled as f64,
            )
            .beside("fixed limits", *fixed as f64);
    }
    let sum = |counts: &[usize]| counts.iter().sum::<usize>() as f64;
    report
        .figure(
            "robots in time in all, controller",
            "robots",
            sum(&controlled),
        )
        .beside("fixed limits", sum(&fixed))
        .reach(Target::RatioAtLeast(1.3))
        .note(format!("of {}", ROBOTS.iter().sum::<usize>()));
    Ok(())
}

/// Robots in time, of so many each.
fn counts(controller: &str) -> Result<Vec<usize>> {
    let place = worker::place()?;
    let config = format!("[capacity]\ncontroller = \"{controller}\"\n{CONFIG}");
    let daemon = worker::daemon(place.path(), &config)?;
    let mut counts = Vec::new();
    for robots in ROBOTS {
        // Rounded down: together no more is promised than there is.
        let part = format!("{:.3}", (cores() / robots as f64 * 1000.0).floor() / 1000.0);
        worker::push(&daemon, &format!("worker{robots}"), &["--cpus", &part])?;
        counts.push(count(&daemon, robots)?);
        eprintln!(
            "controller {controller}, {robots} robots: {} in time",
            counts[counts.len() - 1]
        );
        daemon.deployer().types(&["stop", "--all"])?.succeeded()?;
    }
    daemon.ends()?;
    Ok(counts)
}

fn count(daemon: &Daemon, robots: usize) -> Result<usize> {
    let part = cores() / robots as f64;
    // With twice its part an eager one is in time, if that is not more than its one thread can use.
    let eager = (WORK / (2.0 * part) * 1.4).max(WORK * 1.6);
    let patient = WORK / part * 4.0 + 200.0;
    // All begin together: one that is measured while another's servant still starts has its cores, or lacks them.
    let ready = Barrier::new(robots);
    let outcomes: Vec<Result<bool>> = std::thread::scope(|scope| {
        let all: Vec<_> = (0..robots)
            .map(|number| {
                let (accepts, pause) = match number % 2 {
                    0 => (eager, Duration::ZERO),
                    _ => (patient, Duration::from_secs(1)),
                };
                let ready = &ready;
                scope.spawn(move || {
                    let path = format!("worker{robots}?robot=r{number}&max_rrt={accepts:.0}ms");
                    let robot = robot(daemon, &path);
                    ready.wait();
                    let mut robot = robot?;
                    calls(&mut robot, SETTLES, pause)?;
                    let times = calls(&mut robot, LASTS, pause)?;
                    let within = times.iter().filter(|time| **time <= accepts).count();
                    let part = within as f64 / times.len() as f64;
                    let at = |part| bench_report::quantile(&times, part).unwrap_or(f64::NAN);
                    eprintln!(
                        "  r{number} accepts {accepts:.0} ms: {:.0} % of {} in time, p50 {:.0} ms, p95 {:.0} ms",
                        part * 100.0,
                        times.len(),
                        at(0.5),
                        at(0.95),
                    );
                    Ok(part >= IN_TIME)
                })
            })
            .collect();
        let joined = all
            .into_iter()
            .map(|one| one.join().ok().context("a robot's thread broke")?);
        joined.collect()
    });
    let mut count = 0;
    for outcome in outcomes {
        count += usize::from(outcome?);
    }
    Ok(count)
}
