//! The statements of robots become limits that the kernel enforces, and the limits ensure that the statements hold.

use std::time::Instant;

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::burglar::try_attempt;
use support::daemon::Daemon;
use support::robot::Robot;

use crate::machine::{daemon, read_control_file};

const SERVICE: &str = "burglar_cpp";
/// Work of a request, in rounds of computation.
const WORK: &str = "30000000";
/// Number of requests for a share.
const REQUESTS: usize = 8;
const NEIGHBOURS: usize = 6;

/// Returns the id of a robot's servant.
fn servant_id(daemon: &Daemon, robot: &str) -> anyhow::Result<String> {
    let servant = daemon.servant_of(SERVICE, robot)?;
    Ok(servant["id"].as_str().context("an id")?.to_owned())
}

/// Measures a request as the robot sees it, from sending it to receiving the answer.
fn response_time(robot: &mut Robot) -> anyhow::Result<f64> {
    let asked = Instant::now();
    try_attempt(robot, "work", WORK)?;
    Ok(asked.elapsed().as_secs_f64())
}

fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

/// Returns how many of `REQUESTS` requests were answered within `t_max`.
fn count_in_time(robot: &mut Robot, t_max: f64) -> anyhow::Result<usize> {
    let mut met = 0;
    for _ in 0..REQUESTS {
        met += usize::from(response_time(robot)? <= t_max);
    }
    Ok(met)
}

/// Writes the response times reached with one core and with a quarter of a core; returns both, in seconds.
fn write_rows(daemon: &Daemon) -> anyhow::Result<(f64, f64)> {
    let mut alone = daemon.robot(&format!("{SERVICE}?robot=alone&cpus=1"))?;
    response_time(&mut alone)?;
    let times: anyhow::Result<Vec<f64>> = (0..7).map(|_| response_time(&mut alone)).collect();
    let fast = median(times?) * 1.2;
    let slow = fast * 4.0;
    for (value, cpus) in [(fast, "1"), (slow, "0.25")] {
        let value = format!("{value:.3}");
        let written =
            daemon.deployer().run_json(&["sla", "set", SERVICE, "--rrt", &value, "--cpus", cpus, "--memory", "64M"])?;
        ensure!(written.as_array().is_some(), "{written:#}");
    }
    let servant = servant_id(daemon, "alone")?;
    daemon.deployer().run(&["stop", &servant])?.expect_success()?;
    Ok((fast, slow))
}

fn remove_rows(daemon: &Daemon) -> Verdict {
    let rows = daemon.deployer().run_json(&["sla", "list", SERVICE])?;
    for row in rows.as_array().context("rows")? {
        let number = row["id"].to_string();
        daemon.deployer().run(&["sla", "rm", SERVICE, &number])?.expect_success()?;
    }
    Ok(())
}

/// Ratio of the accepted to the desired response time.
const ACCEPTS: f64 = 2.0;

/// Connects a robot with an SLA.
fn robot(daemon: &Daemon, name: &str, rrt: f64) -> anyhow::Result<Robot> {
    let (rrt, max) = (format!("{rrt:.3}"), format!("{:.3}", rrt * ACCEPTS));
    daemon.robot(&format!("{SERVICE}?robot={name}&rrt={rrt}&max_rrt={max}"))
}

fn find_servant(daemon: &Daemon, name: &str) -> anyhow::Result<Value> {
    daemon.servant_of(SERVICE, name)
}

pub fn what_robots_state_becomes_what_the_kernel_enforces_and_is_kept() -> Verdict {
    let daemon = daemon()?;
    let (fast, slow) = write_rows(&daemon)?;
    let mut swift = robot(&daemon, "swift", fast)?;
    let mut patient = robot(&daemon, "patient", slow)?;
    for robot in [&mut swift, &mut patient] {
        try_attempt(robot, "rest", "")?;
    }
    let (swifts, patients) = (servant_id(&daemon, "swift")?, servant_id(&daemon, "patient")?);
    let at_first = (read_control_file(&swifts, "cpu.max")?, read_control_file(&patients, "cpu.max")?);
    println!("        cpu.max of swift: {}; of patient: {}", at_first.0, at_first.1);
    // On a slow machine the controller may have raised them by now.
    let (of_swift, of_patient) = (quota(&swifts)?, quota(&patients)?);
    ensure!(
        of_swift >= 100_000 && (25_000..of_swift).contains(&of_patient),
        "{at_first:?}: {:#} {:#}",
        find_servant(&daemon, "swift")?,
        find_servant(&daemon, "patient")?
    );
    for (robot, cpus) in [("swift", 1.0), ("patient", 0.25)] {
        let row = find_servant(&daemon, robot)?["terms"]["rows"][0]["limits"]["cpus"].clone();
        ensure!(row == cpus, "{robot}: {row}");
    }
    ensure!(read_control_file(&swifts, "memory.max")? == (64 << 20).to_string());
    // A robot with the same requests that states nothing: no row gives it limits or a promise.
    let mut plain = daemon.robot(&format!("{SERVICE}?robot=plain"))?;
    try_attempt(&mut plain, "rest", "")?;
    let mut neighbours = Vec::new();
    for number in 0..NEIGHBOURS {
        neighbours.push(daemon.robot(&format!("{SERVICE}?robot=greedy{number}"))?);
    }
    // All start before the first one slows down the others.
    for what in ["rest", "burn"] {
        for neighbour in &mut neighbours {
            try_attempt(neighbour, what, "2")?;
        }
    }
    let t_max = fast * ACCEPTS;
    // Alternating, so that other load on the host affects both alike.
    let (mut with, mut without, mut asked) = (0, 0, 0);
    for _ in 0..3 {
        with += count_in_time(&mut swift, t_max)?;
        without += count_in_time(&mut plain, t_max)?;
        asked += REQUESTS;
        // Robots without requests answer the daemon's pings only when they read, as robots do all the time.
        for idle in neighbours.iter_mut().chain([&mut patient]) {
            idle.call("/rosapi/get_time", json!({}))?;
        }
    }
    let share = |met: usize| 100.0 * met as f64 / asked as f64;
    println!(
        "        T_max {:.0} ms beside {NEIGHBOURS} greedy neighbours: {:.0} % of requests within it with the row's \
         limits, {:.0} % of a robot that has none",
        t_max * 1000.0,
        share(with),
        share(without)
    );
    for neighbour in &mut neighbours {
        try_attempt(neighbour, "rest", "")?;
    }
    daemon.deployer().run(&["stop", "--service", SERVICE])?.expect_success()?;
    remove_rows(&daemon)?;
    // The number of requests in time depends on the host as well; that limits make the difference does not.
    ensure!(share(with) >= share(without) + 30.0, "the row's limits change nothing");
    Ok(())
}

/// Work of a request that uses a core for its whole duration.
const LITTLE_WORK: &str = "3000000";

/// Returns the microseconds of each period that a servant may use.
fn quota(id: &str) -> anyhow::Result<u64> {
    let max = read_control_file(id, "cpu.max")?;
    let quota = max.split(' ').next().unwrap_or_default();
    quota.parse().with_context(|| format!("cpu.max is {max}"))
}

pub fn the_controller_moves_cores_and_nobody_loses_what_was_promised() -> Verdict {
    let daemon = daemon()?;
    let mut alone = daemon.robot(&format!("{SERVICE}?robot=alone&cpus=1"))?;
    let little = |robot: &mut Robot| -> anyhow::Result<f64> {
        let asked = Instant::now();
        try_attempt(robot, "work", LITTLE_WORK)?;
        Ok(asked.elapsed().as_secs_f64())
    };
    little(&mut alone)?;
    let times: anyhow::Result<Vec<f64>> = (0..7).map(|_| little(&mut alone)).collect();
    let took = median(times?);
    let servant = servant_id(&daemon, "alone")?;
    daemon.deployer().run(&["stop", &servant])?.expect_success()?;
    let mut plain = daemon.robot(&format!("{SERVICE}?robot=plain"))?;
    try_attempt(&mut plain, "rest", "1")?;
    let unmoved = quota(&servant_id(&daemon, "plain")?)?;
    // With a quarter of a core it takes four times as long. Its robot uses rosbridge, so the daemon measures its calls.
    let accepts = format!("{:.4}", took * 2.0);
    let near = format!("{SERVICE}?robot=near&cpus=0.25&max_rrt={accepts}");
    let mut near = daemon.robot(&near)?;
    let mut owner = daemon.robot(&format!("{SERVICE}?robot=owner&cpus=0.25"))?;
    for (robot, what) in [(&mut near, "rest"), (&mut owner, "burn"), (&mut plain, "burn")] {
        try_attempt(robot, what, "1")?;
    }
    let ids = [servant_id(&daemon, "near")?, servant_id(&daemon, "owner")?, servant_id(&daemon, "plain")?];
    let quotas = || -> anyhow::Result<Vec<u64>> { ids.iter().map(|id| quota(id)).collect() };
    // The promises of two of them, and the limit of the third without the controller.
    let at_first = vec![25_000, 25_000, unmoved];
    let mut seen = Vec::new();
    let mut promises_hold = |now: &[u64]| -> anyhow::Result<()> {
        if seen.last().is_none_or(|last: &Vec<u64>| last != now) {
            seen.push(now.to_vec());
        }
        ensure!(now[0] >= 25_000 && now[1] == 25_000, "{seen:?}");
        Ok(())
    };
    support::wait_until("cores for the one that is near", || {
        little(&mut near)?;
        let now = quotas()?;
        promises_hold(&now)?;
        let moved = now[0] > at_first[0] && now[2] < at_first[2];
        Ok(if moved { Ok(()) } else { Err(format!("{now:?}")) })
    })?;
    let events = daemon.api("/api/v1/events?limit=1000")?;
    let told = events.as_array().context("events")?.iter();
    let mut told = told.filter(|event| event["kind"] == "cores-moved");
    let reason = told.find(|event| event["robot"] == "near");
    println!("        {}", reason.context("an event of it")?["message"].as_str().unwrap_or_default());
    let shown = servant_field(&daemon, "near", "response")?;
    ensure!(shown["requests"].as_u64() > Some(0), "{shown}");
    // The robot makes no more requests and gives back what it had gained.
    let mut last = quotas()?;
    // Far more steps than needed, if the limits settle at all.
    for _ in 0..100 {
        if last == at_first {
            break;
        }
        // Half of the difference at each step, with some seconds between steps.
        last = support::wait_until("less, until it is what it was promised", || {
            let now = quotas()?;
            promises_hold(&now)?;
            Ok(if now == last { Err(format!("{now:?}")) } else { Ok(now) })
        })?;
    }
    ensure!(last == at_first, "it does not come to rest: {seen:?}");
    println!("        cpu.max of near, owner, plain: {seen:?}");
    for robot in [&mut owner, &mut plain] {
        try_attempt(robot, "rest", "")?;
    }
    daemon.deployer().run(&["stop", "--service", SERVICE])?.expect_success().map(|_| ())
}

/// Returns a field of a robot's servant.
fn servant_field(daemon: &Daemon, robot: &str, field: &str) -> anyhow::Result<Value> {
    Ok(find_servant(daemon, robot)?[field].clone())
}
