//! Number of a machine's robots that are answered in time, with fixed limits as promised and with the controller. All
//! robots are promised an equal share of the machine. Every other robot, beginning with the first, calls again as soon
//! as it is answered and accepts a shorter response time than its share allows; the others call rarely and accept a
//! longer one.

use std::sync::Barrier;
use std::time::Duration;

use anyhow::{Context, Result};
use bench_report::{BenchReport, Target};
use support::daemon::Daemon;

use crate::worker::{self, WORK, connect_robot, cores, time_calls};

const ROBOTS: [usize; 7] = [2, 3, 4, 5, 6, 7, 8];
const LASTS: Duration = Duration::from_secs(15);
/// Time until the controller has settled.
const SETTLES: Duration = Duration::from_secs(15);
/// Fraction of a robot's requests that must be in time for the robot to count.
const IN_TIME: f64 = 0.95;
const CONFIG: &str = "[servant]\nwarm_pool = 0\nstart = \"5m\"\n";

pub(crate) fn measure(report: &mut BenchReport) -> Result<()> {
    let fixed = count_by_fleet_size("off")?;
    let controlled = count_by_fleet_size("on")?;
    for ((robots, controlled), fixed) in ROBOTS.iter().zip(&controlled).zip(&fixed) {
        report
            .figure(
                format!("of {robots} robots in time, controller"),
                "robots",
                *controlled as f64,
            )
            .relative_to("fixed limits", *fixed as f64);
    }
    let sum = |counts: &[usize]| counts.iter().sum::<usize>() as f64;
    report
        .figure(
            "robots in time in all, controller",
            "robots",
            sum(&controlled),
        )
        .relative_to("fixed limits", sum(&fixed))
        .require(Target::RatioAtLeast(1.3))
        .note(format!("of {}", ROBOTS.iter().sum::<usize>()));
    Ok(())
}

/// Returns the number of robots in time for each fleet size.
fn count_by_fleet_size(controller: &str) -> Result<Vec<usize>> {
    let place = worker::temporary_directory()?;
    let config = format!("[capacity]\ncontroller = \"{controller}\"\n{CONFIG}");
    let daemon = worker::start_daemon(place.path(), &config)?;
    let mut counts = Vec::new();
    for robots in ROBOTS {
        // Rounded down so that the promises never add up to more than the machine has.
        let part = format!("{:.3}", (cores() / robots as f64 * 1000.0).floor() / 1000.0);
        worker::push_worker(&daemon, &format!("worker{robots}"), &["--cpus", &part])?;
        counts.push(count_in_time(&daemon, robots)?);
        eprintln!(
            "controller {controller}, {robots} robots: {} in time",
            counts[counts.len() - 1]
        );
        daemon
            .deployer()
            .run(&["stop", "--all"])?
            .expect_success()?;
    }
    daemon.stop()?;
    Ok(counts)
}

fn count_in_time(daemon: &Daemon, robots: usize) -> Result<usize> {
    let part = cores() / robots as f64;
    // With twice its share an eager robot is in time, unless that is more than its single thread can use.
    let eager = (WORK / (2.0 * part) * 1.4).max(WORK * 1.6);
    let patient = WORK / part * 4.0 + 200.0;
    // All start together: a robot measured while another's servant is still starting would have that servant's cores,
    // or lack them.
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
                    let robot = connect_robot(daemon, &path);
                    ready.wait();
                    let mut robot = robot?;
                    time_calls(&mut robot, SETTLES, pause)?;
                    let times = time_calls(&mut robot, LASTS, pause)?;
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
