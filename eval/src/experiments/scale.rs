//! Experiment 10: one to a hundred robots on one node, each with a servant of its own: start times of servants,
//! response times, cost per robot, the load at which response times rise, and the number of nodes that more robots
//! would need.

mod counters;
mod report;

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use serde::{Deserialize, Serialize};
use support::daemon::Daemon;
use support::robot::Robot;

use crate::cells::{RunCache, Runs};
use crate::experiments::crowd::{self, Controller, CrowdDaemon, SHORT};
use crate::section::About;
use counters::{CoreUsage, TimeCounters, available_memory};

pub use report::section;

/// The experiment.
pub const ABOUT: About = About {
    number: 10,
    id: "scale",
    title: "How many robots a node serves",
    published: "Starting a servant took over 5 s.",
    differs: &[
        "Each robot is a connection of one process on the same machine, pauses for 200 ms on average after each \
         answer, and has a servant, of a node that computes for 8 ms of a core at each call and needs little memory.",
        "Every other point was held back from the model's fit; the others determine its two parameters.",
    ],
};

/// Mean pause in seconds between an answer and the robot's next request; pauses are exponentially distributed, so that
/// robots do not synchronize.
const THINK: f64 = 0.2;

/// Inputs of a point.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct ScalePlan {
    robots: usize,
    settles: f64,
    lasts: f64,
    think: f64,
    work: u32,
    cores: f64,
}

/// Measurements with a number of robots.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct ScalePoint {
    /// Number of each robot that was added, and the seconds from its connection until its servant had answered a first
    /// call, without calls of the others meanwhile.
    starts: Vec<(usize, f64)>,
    /// Response times of all requests, in seconds.
    times: Vec<f64>,
    lasted: f64,
    used: CoreUsage,
    /// Memory of the servants' cgroups, in bytes.
    servants_memory: f64,
    /// Decrease of the machine's available memory since before the first robot, in bytes.
    taken: f64,
    /// Available memory and total memory, in bytes.
    left: (f64, f64),
    /// Number of such servants that the daemon admits on this machine.
    admits: u64,
}

/// Results of all points, ordered by number of robots.
pub struct ScaleRuns(Vec<(ScalePlan, Runs<ScalePoint>)>);

/// Connected robots, and the machine's state before they connected.
struct ConnectedRobots {
    robots: Vec<Robot>,
    available: f64,
}

/// Measures all points; with `quick`, few robots for a short time.
pub fn measure(cells: &RunCache, yard: &mut CrowdDaemon, quick: bool) -> Result<ScaleRuns> {
    let numbers: &[usize] = if quick { &[1, 2, 4] } else { &[1, 2, 4, 8, 16, 32, 64, 100] };
    let (settles, lasts) = if quick { (0.3, 2.0) } else { (1.0, 8.0) };
    let (think, work, cores) = (THINK, SHORT.milliseconds, crowd::cores());
    let plan = |robots: &usize| ScalePlan { robots: *robots, settles, lasts, think, work, cores };
    let mut points: Vec<(ScalePlan, Runs<ScalePoint>)> =
        numbers.iter().map(|robots| (plan(robots), Runs::default())).collect();
    for run in 0..cells.run_names("scale").len() {
        let mut crowd = None;
        for (plan, runs) in &mut points {
            let plan = &*plan;
            let name = &cells.run_names(&format!("scale {}", plan.robots))[run];
            cells.add_run(runs, name, plan, || {
                // Robots of the previous point stay; after a failure all of them reconnect.
                let mut here = match crowd.take() {
                    Some(here) => here,
                    None => gather(yard)?,
                };
                let point = measure_point(yard.open(Controller::Off)?, &mut here, plan)?;
                crowd = Some(here);
                Ok(point)
            })?;
        }
    }
    Ok(ScaleRuns(points))
}

fn gather(yard: &mut CrowdDaemon) -> Result<ConnectedRobots> {
    let daemon = yard.without_servants(Controller::Off)?;
    crowd::publish(daemon, SHORT)?;
    Ok(ConnectedRobots { robots: Vec::new(), available: available_memory()?.0 })
}

fn measure_point(daemon: &Daemon, crowd: &mut ConnectedRobots, plan: &ScalePlan) -> Result<ScalePoint> {
    let mut starts = Vec::new();
    while crowd.robots.len() < plan.robots {
        let number = crowd.robots.len() + 1;
        let asked = Instant::now();
        let answered = || -> Result<Robot> {
            let mut robot = crowd::join(daemon, SHORT, &format!("r{number}"), "")?;
            crowd::time_call(&mut robot)?;
            Ok(robot)
        };
        let robot = answered().with_context(|| format!("the servant of robot {number}"))?;
        starts.push((number, asked.elapsed().as_secs_f64()));
        crowd.robots.push(robot);
    }
    let left = available_memory()?;
    let servants_memory = crowd::usage(daemon, SHORT)?.1;
    let (times, used, lasted) = ask(daemon, &mut crowd.robots, plan)?;
    ensure!(!times.is_empty(), "no request was answered in time");
    Ok(ScalePoint {
        starts,
        times,
        lasted,
        used,
        servants_memory,
        taken: crowd.available - left.0,
        left,
        admits: admission_limit(daemon, plan.robots)?,
    })
}

/// Has all robots make calls, each on a thread that mostly sleeps; returns the response times, the cores used, and the
/// duration in seconds.
fn ask(daemon: &Daemon, robots: &mut [Robot], plan: &ScalePlan) -> Result<(Vec<f64>, CoreUsage, f64)> {
    let from = Instant::now() + Duration::from_secs_f64(plan.settles);
    let to = from + Duration::from_secs_f64(plan.lasts);
    std::thread::scope(|scope| {
        let asking: Vec<_> = robots
            .iter_mut()
            .zip(0..)
            .map(|(robot, seed)| {
                scope.spawn(move || {
                    let mut random = StdRng::seed_from_u64(seed);
                    let pause = || -plan.think * (1.0 - random.random::<f64>()).ln();
                    crowd::time_calls(robot, (from, to), pause)
                })
            })
            .collect();
        std::thread::sleep(from.saturating_duration_since(Instant::now()));
        let (before, begun) = (TimeCounters::read(daemon)?, Instant::now());
        std::thread::sleep(to.saturating_duration_since(Instant::now()));
        let (after, lasted) = (TimeCounters::read(daemon)?, begun.elapsed().as_secs_f64());
        let mut times = Vec::new();
        for robot in asking {
            times.extend(robot.join().ok().context("a robot's thread broke")??);
        }
        Ok((times, after.cores_since(&before, lasted), plan.lasts))
    })
}

/// Returns how many servants of this kind the daemon admits, given what it reserves for each.
fn admission_limit(daemon: &Daemon, robots: usize) -> Result<u64> {
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
