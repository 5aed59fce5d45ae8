//! Calls per second of fifty robots that share servants, beside one robot with a servant of its own and a roscpp client
//! in the same container. Each call waits for two milliseconds, so that servants are shared and not cores.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bench_report::{BenchDaemon, BenchReport, Target};
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::robot::Robot;

const PACKAGE: &str = "sharer_cpp";
const ROBOTS: usize = 50;
const LASTS: Duration = Duration::from_secs(5);
const WORK: f64 = 0.002;

/// Services to push: name and further arguments of the push.
const PUSHED: [(&str, &[&str]); 4] = [
    ("own", &["--node", "sharer"]),
    ("one", &["--node", "sharer", "--shared", "--max", "1"]),
    ("two", &["--node", "sharer", "--shared", "--min", "2", "--max", "2"]),
    ("roscpp", &["--node", "sharer", "--node", "asker", "--param", "seconds=0.002"]),
];

pub fn measure(report: &mut BenchReport) -> Result<()> {
    let daemon = BenchDaemon::start("[capacity]\ncpus = 64\n")?;
    for (name, arguments) in PUSHED {
        let arguments = [&["--name", name, "--cpus", "0.5"], arguments].concat();
        daemon.deployer().push(PACKAGE, &arguments)?.expect_success()?;
    }
    let roscpp = roscpp_call_rate(&daemon)?;
    let single = measure_call_rate(&daemon, "own", 1)?;
    let figure = report.figure("one robot at a servant of its own", "calls/s", single);
    figure.relative_to("roscpp in the same container", roscpp);
    for (name, servants) in [("one", 1), ("two", 2)] {
        let shared = measure_call_rate(&daemon, name, ROBOTS)?;
        let sum = single * f64::from(servants);
        let figure = report.figure(format!("{ROBOTS} robots at {servants} shared"), "calls/s", shared);
        figure.relative_to(format!("{servants} x one robot at its own"), sum).require(Target::RatioAtLeast(0.9));
        let figure = report.figure(format!("{ROBOTS} robots at {servants} shared"), "calls/s", shared);
        figure.relative_to(format!("{servants} x roscpp in the same container"), roscpp * f64::from(servants));
    }
    Ok(())
}

/// Returns the calls per second of `robots` robots, each of which makes one call after the other.
fn measure_call_rate(daemon: &Daemon, service: &str, robots: usize) -> Result<f64> {
    let mut ready = Vec::new();
    for number in 0..robots {
        let mut robot = daemon.robot(&format!("{service}?robot=r{number}"))?;
        call(&mut robot)?;
        ready.push(robot);
    }
    let wanted = if service == "two" { 2 } else { 1 };
    daemon.wait_for(&format!("/api/v1/services/{service}"), "its servants", |found| {
        let groups = found["groups"].as_array();
        let servants = groups.and_then(|all| all.first()).map(|group| &group["servants"]);
        let ready = |one: &&Value| one["ready"] == true;
        let count = servants.map_or(1, |all| all.as_array().map_or(0, |all| all.iter().filter(ready).count()));
        (count >= wanted).then_some(())
    })?;
    let (counted, over) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicBool::new(false)));
    let began = Instant::now();
    let working: Vec<_> = ready
        .into_iter()
        .map(|mut robot| {
            let (counted, over) = (Arc::clone(&counted), Arc::clone(&over));
            thread::spawn(move || -> Result<()> {
                while !over.load(Ordering::Relaxed) {
                    call(&mut robot)?;
                    counted.fetch_add(1, Ordering::Relaxed);
                }
                Ok(())
            })
        })
        .collect();
    thread::sleep(LASTS);
    let rate = counted.load(Ordering::Relaxed) as f64 / began.elapsed().as_secs_f64();
    over.store(true, Ordering::Relaxed);
    for robot in working {
        robot.join().map_err(|_| anyhow::anyhow!("a robot panicked"))??;
    }
    Ok(rate)
}

fn call(robot: &mut Robot) -> Result<()> {
    let answer = robot.call("/work", json!({ "who": "r", "seconds": WORK }))?;
    ensure!(answer["result"] == true, "{answer}");
    Ok(())
}

/// Returns the rate that the roscpp client prints, in calls per second.
fn roscpp_call_rate(daemon: &Daemon) -> Result<f64> {
    let _robot = daemon.robot("roscpp?robot=r")?;
    let servant = daemon.servant_of("roscpp", "r")?;
    let id = servant["id"].as_str().context("an id")?.to_owned();
    support::wait_until("its figure", || {
        let said = daemon.deployer().run(&["logs", &id])?.output();
        let figure = said.split("calls a second: ").nth(1);
        let figure = figure.and_then(|rest| rest.split_whitespace().next()?.parse().ok());
        Ok(figure.ok_or(said))
    })
}
