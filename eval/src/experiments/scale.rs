//! Experiment 10: one robot to a hundred on one node, each with a servant of its own: how long servants take to start, response times,
//! what each robot costs, where it bends, and how many nodes more robots would need.

mod counters;
mod tell;

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};
use support::daemon::Daemon;
use support::robot::Robot;

use crate::cells::{Cells, Measured};
use crate::experiments::crowd::{self, Controller, SHORT, Yard};
use crate::statistics::Xorshift;
use counters::{Cores, Counters, available_memory};

pub use tell::section;

/// Seconds for which a robot pauses between an answer and its next request, on average; the pauses are exponentially distributed, so
/// that robots do not keep step.
const THINK: f64 = 0.2;

/// What a point depends on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct Plan {
    robots: usize,
    settles: f64,
    lasts: f64,
    think: f64,
    work: u32,
    cores: f64,
}

/// So many robots at once.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Point {
    /// The how many-th robot of the node, and the seconds from connecting until its servant had answered a first call; none of the
    /// others asked meanwhile.
    starts: Vec<(usize, f64)>,
    /// Of all requests, seconds.
    times: Vec<f64>,
    /// Seconds in which they were made.
    lasted: f64,
    /// Cores that were used meanwhile.
    used: Cores,
    /// Memory of the servants' control groups, bytes.
    servants_memory: f64,
    /// Memory that the machine has less than before the first robot, bytes.
    taken: f64,
    /// Memory that is left, and all, bytes.
    left: (f64, f64),
    /// Servants of this kind for which the daemon makes room on this machine.
    admits: u64,
}

/// All points, in the order of their robots.
pub struct Runs(Vec<(Plan, Measured<Point>)>);

/// Robots that are connected, and what the machine had before they came.
struct Crowd {
    robots: Vec<Robot>,
    available: f64,
}

/// Measures it; few robots for a short time where `quick`.
pub fn measure(cells: &Cells, yard: &mut Yard, quick: bool) -> Result<Runs> {
    let numbers: &[usize] = if quick {
        &[1, 2, 4]
    } else {
        &[1, 2, 4, 8, 16, 32, 64, 100]
    };
    let (settles, lasts) = if quick { (0.3, 2.0) } else { (1.0, 8.0) };
    let mut crowd = None;
    let mut points = Vec::new();
    for robots in numbers.iter().copied() {
        let plan = Plan {
            robots,
            settles,
            lasts,
            think: THINK,
            work: SHORT.milliseconds,
            cores: crowd::cores(),
        };
        let measured = cells.measure(&format!("scale {robots}"), &plan, || {
            // Robots of the point before stay; where it failed, all come anew.
            let mut here = match crowd.take() {
                Some(here) => here,
                None => gathers(yard)?,
            };
            let point = point(yard.open(Controller::Off)?, &mut here, &plan)?;
            crowd = Some(here);
            Ok(point)
        })?;
        points.push((plan, measured));
    }
    Ok(Runs(points))
}

fn gathers(yard: &mut Yard) -> Result<Crowd> {
    let daemon = yard.cleared(Controller::Off)?;
    crowd::publishes(daemon, SHORT)?;
    Ok(Crowd {
        robots: Vec::new(),
        available: available_memory()?.0,
    })
}

fn point(daemon: &Daemon, crowd: &mut Crowd, plan: &Plan) -> Result<Point> {
    let mut starts = Vec::new();
    while crowd.robots.len() < plan.robots {
        let number = crowd.robots.len() + 1;
        let asked = Instant::now();
        let answered = || -> Result<Robot> {
            let mut robot = crowd::joins(daemon, SHORT, &format!("r{number}"), "")?;
            crowd::call(&mut robot)?;
            Ok(robot)
        };
        let robot = answered().with_context(|| format!("the servant of robot {number}"))?;
        starts.push((number, asked.elapsed().as_secs_f64()));
        crowd.robots.push(robot);
    }
    let left = available_memory()?;
    let servants_memory = crowd::usage(daemon, SHORT)?.1;
    let (times, used, lasted) = asks(daemon, &mut crowd.robots, plan)?;
    ensure!(!times.is_empty(), "no request was answered in time");
    Ok(Point {
        starts,
        times,
        lasted,
        used,
        servants_memory,
        taken: crowd.available - left.0,
        left,
        admits: admits(daemon, plan.robots)?,
    })
}

/// All robots ask, each in a thread that mostly sleeps: times of the requests, cores that were used, and seconds in which that was.
fn asks(daemon: &Daemon, robots: &mut [Robot], plan: &Plan) -> Result<(Vec<f64>, Cores, f64)> {
    let from = Instant::now() + Duration::from_secs_f64(plan.settles);
    let to = from + Duration::from_secs_f64(plan.lasts);
    std::thread::scope(|scope| {
        let asking: Vec<_> = robots
            .iter_mut()
            .zip(0..)
            .map(|(robot, seed)| {
                scope.spawn(move || {
                    let mut random = Xorshift::new(seed);
                    crowd::calls(robot, (from, to), || random.exponential(plan.think))
                })
            })
            .collect();
        std::thread::sleep(from.saturating_duration_since(Instant::now()));
        let (before, begun) = (Counters::now(daemon)?, Instant::now());
        std::thread::sleep(to.saturating_duration_since(Instant::now()));
        let (after, lasted) = (Counters::now(daemon)?, begun.elapsed().as_secs_f64());
        let mut times = Vec::new();
        for robot in asking {
            times.extend(robot.join().ok().context("a robot's thread broke")??);
        }
        Ok((times, after.since(&before, lasted), plan.lasts))
    })
}

/// How many servants like these the daemon promises room, by what it reserves for each.
fn admits(daemon: &Daemon, robots: usize) -> Result<u64> {
    let status = daemon.api("/api/v1/status")?;
    let number = |key: &str| {
        let value = status["capacity"][key].as_f64();
        value.with_context(|| format!("{key} in the capacity of {status}"))
    };
    let room = |all: f64, reserved: f64| all / (reserved / robots as f64).max(f64::MIN_POSITIVE);
    let cpus = room(number("cpus")?, number("cpus_reserved")?);
    let memory = room(number("memory")?, number("memory_reserved")?);
    Ok(cpus.min(memory) as u64)
}
