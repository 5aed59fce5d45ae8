//! `make bench ONLY=survival`: a daemon is killed under traffic and started again, a hundred times; how many of its
//! servants are lost, and how long it takes to find them beside its first start with none. Needs root.

#![forbid(unsafe_code)]

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bench_report::{Report, Target};
use serde_json::{Value, json};
use support::daemon::{Daemon, Setup};
use support::robot::Robot;

/// How often it is killed; `CLOUDROID_BENCH_ROUNDS` says otherwise.
const ROUNDS: u32 = 100;
/// Servants that are to be found again each time.
const ROBOTS: [&str; 3] = ["r1", "r2", "r3"];
const CONFIG: &str = "keep_servants = true\n[servant]\nwarm_pool = 0\ngrace = \"1h\"\n";

fn path(robot: &str) -> String {
    format!("greeter_cpp?robot={robot}")
}

/// What must be the same afterwards: who serves, and as which processes.
fn servants(daemon: &Daemon) -> Result<Vec<(Value, Value)>> {
    ROBOTS
        .iter()
        .map(|robot| {
            let servant = daemon.servant_of("greeter_cpp", robot)?;
            Ok((servant["id"].clone(), servant["pids"].clone()))
        })
        .collect()
}

fn count(robot: &mut Robot) -> Result<u64> {
    let answer = robot.calls("/greeter/count", json!({"reset": false}))?;
    answer["values"]["count"]
        .as_u64()
        .with_context(|| answer.to_string())
}

/// Publishes until the node has counted on; how far.
fn greet(robot: &mut Robot) -> Result<u64> {
    let before = count(robot)?;
    robot.says(json!({"op": "advertise", "topic": "/greeter/name", "type": "std_msgs/String"}))?;
    robot.awaits_subscriber("/greeter/name")?;
    loop {
        robot.says(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": "x"}}))?;
        let now = count(robot)?;
        if now > before {
            return Ok(now);
        }
    }
}

/// In milliseconds.
fn median(times: &[Duration]) -> f64 {
    bench_report::quantile(times, 0.5).map_or(f64::NAN, |time| time.as_secs_f64() * 1e3)
}

fn main() -> Result<()> {
    let rounds = match std::env::var("CLOUDROID_BENCH_ROUNDS") {
        Ok(rounds) => rounds.parse().context("CLOUDROID_BENCH_ROUNDS")?,
        Err(_) => ROUNDS,
    };
    let place = tempfile::Builder::new()
        .prefix("cloudroid-bench-")
        .tempdir()?;
    let setup = Setup::new(&place.path().join("home")).config(CONFIG);
    let daemon = setup.start()?;
    daemon
        .deployer()
        .pushes("greeter_cpp", &["--node", "greeter"])?
        .succeeded()?;
    daemon.ends()?;
    let timed = |setup: &Setup| -> Result<(Daemon, Duration)> {
        let began = Instant::now();
        Ok((setup.start()?, began.elapsed()))
    };
    let mut alone = Vec::new();
    for _ in 0..5 {
        let (daemon, took) = timed(&setup)?;
        alone.push(took);
        daemon.is_killed()?;
    }
    let mut daemon = setup.start()?;
    for robot in ROBOTS {
        greet(&mut daemon.robot(&path(robot))?)?;
    }
    let before = servants(&daemon)?;
    let (mut lost, mut forgotten, mut found) = (0, 0, Vec::new());
    for round in 0..rounds {
        // One of them is at work when it happens.
        let mut robot = daemon.robot(&path(ROBOTS[round as usize % ROBOTS.len()]))?;
        let counted = greet(&mut robot)?;
        robot.says(json!({"op": "call_service", "service": "/greeter/count", "args": {}}))?;
        daemon.is_killed()?;
        let (next, took) = timed(&setup)?;
        daemon = next;
        found.push(took);
        let after = servants(&daemon);
        lost += match &after {
            Ok(after) => before
                .iter()
                .zip(after)
                .filter(|(before, after)| before != after)
                .count(),
            Err(_) => ROBOTS.len(),
        };
        let mut robot = daemon.robot(&path(ROBOTS[round as usize % ROBOTS.len()]))?;
        // More than was heard back may have been on its way.
        if count(&mut robot)? < counted {
            forgotten += 1;
        }
        ensure!(lost == 0, "round {round}: {before:?} became {after:?}");
    }
    daemon.deployer().types(&["stop", "--all"])?.succeeded()?;
    daemon.ends()?;
    let mut report = Report::new("survival");
    report
        .figure(
            format!("servants lost in {rounds} rounds of kill -9"),
            "",
            lost as f64,
        )
        .reach(Target::AtMost(0.0))
        .note(format!("{} servants, one of them at work", ROBOTS.len()));
    report
        .figure(
            "nodes that had forgotten what they knew",
            "",
            f64::from(forgotten),
        )
        .reach(Target::AtMost(0.0));
    report
        .figure(
            "start until it answers, with servants to find",
            "ms",
            median(&found),
        )
        .beside("with none", median(&alone))
        .note("medians");
    report.finish()?;
    Ok(())
}
