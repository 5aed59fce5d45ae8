//! The warm pool: containers created ahead of the robots that use them.

use std::collections::BTreeSet;
use std::fs;

use anyhow::{Context, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::robot::Robot;
use support::world::world;

pub fn a_robot_takes_the_container_made_ahead_and_another_is_made() -> Verdict {
    // Enough for one container.
    let setup = world().setup("warm-pool");
    let daemon = setup.config("[servant]\nwarm_memory = \"4M\"\n").start()?;
    daemon.deployer().push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    let first = wait_for_warm_container(&daemon, &BTreeSet::new())?;
    ensure!(daemon.servants_of("adder_py")?.is_empty(), "a warm container is nobody's servant");
    let mut one = daemon.robot("adder_py?robot=one")?;
    one.call("/add_two", json!({"a": 1, "b": 1}))?;
    ensure!(servant_id(&daemon, "one")? == first, "the warm container was used");

    let second = wait_for_warm_container(&daemon, &BTreeSet::from([first.clone()]))?;
    // A warm container that dies does not make a robot wait.
    kill_shim(&daemon, &second)?;
    let mut two = daemon.robot("adder_py?robot=two")?;
    two.call("/add_two", json!({"a": 2, "b": 2}))?;
    one.call("/add_two", json!({"a": 3, "b": 3}))?;

    daemon.deployer().run(&["rm", "adder_py"])?.expect_success()?;
    ensure!(servant_directories(&daemon)?.is_empty(), "left: {:?}", servant_directories(&daemon)?);
    Ok(())
}

pub fn a_robot_takes_a_servant_whose_nodes_run() -> Verdict {
    let setup =
        world().setup("warm-nodes").config("[capacity]\ncpus = 2\n[servant]\nwarm_nodes = 1\nreserve_cpus = 1.0\n");
    let daemon = setup.start()?;
    daemon.deployer().push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    wait_for_warm_nodes(&daemon)?;
    let promised = daemon.api("/api/v1/status")?["capacity"]["cpus_reserved"].clone();
    ensure!(promised == 1.0, "{promised} cores are promised to it");
    let before = process_ids()?;
    let mut one = daemon.robot("adder_py?robot=one")?;
    let answer = one.call("/add_two", json!({"a": 1, "b": 1}))?;
    ensure!(answer["values"]["sum"] == 2, "{answer}");
    let servant = daemon.servant_of("adder_py", "one")?;
    let pids = servant["pids"].as_array().context("pids")?;
    ensure!(
        !pids.is_empty() && pids.iter().all(|pid| before.contains(&pid.to_string())),
        "its node was started for it: {servant}"
    );
    let told = daemon.deployer().run_json(&["events"])?.to_string();
    ensure!(!told.contains("~warm"), "it is somebody's now: {told}");

    // Another one is ready as well. It ends as soon as its capacity is needed.
    wait_for_warm_nodes(&daemon)?;
    let other = ["--name", "other", "--node", "adder.py"];
    daemon.deployer().push("adder_py", &other)?.expect_success()?;
    let mut two = daemon.robot("other?robot=two")?;
    let answer = two.call("/add_two", json!({"a": 2, "b": 2}))?;
    ensure!(answer["values"]["sum"] == 4, "{answer}");
    one.call("/add_two", json!({"a": 3, "b": 3}))?;

    // After the daemon was killed, warm containers still belong to nobody.
    daemon.deployer().run(&["stop", "--all"])?.expect_success()?;
    wait_for_warm_nodes(&daemon)?;
    let left = servant_directories(&daemon)?;
    daemon.kill()?;
    let daemon = setup.start()?;
    wait_for_warm_nodes(&daemon)?;
    // Robots come first: the warm containers of the killed daemon are ended in the background.
    support::wait_until("the end of what nobody knows the state of", || {
        let still: Vec<_> = servant_directories(&daemon)?.intersection(&left).cloned().collect();
        Ok(if still.is_empty() { Ok(()) } else { Err(format!("{still:?} are there")) })
    })?;
    let told = daemon.deployer().run_json(&["events"])?.to_string();
    ensure!(!told.contains("servant-lost") && !told.contains("servant-unknown"), "{told}");
    Ok(())
}

pub fn a_service_that_fails_again_and_again_says_when_it_is_tried() -> Verdict {
    let daemon = world().setup("back-off").start()?;
    daemon.deployer().push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    // Delays grow until one exceeds the time between two requests, however slow this machine is.
    let refusal = support::wait_until("a refusal", || {
        let mut robot = match Robot::try_connect(&daemon.url("adder_py?robot=one")) {
            Ok(robot) => robot,
            Err(refusal) => return Ok(Ok(refusal)),
        };
        robot.call("/add_two", json!({"a": 1, "b": 1}))?;
        kill_shim(&daemon, &servant_id(&daemon, "one")?)?;
        robot.wait_for_close()?;
        support::wait_until("the servant's end", || {
            let left = daemon.servants_of("adder_py")?;
            Ok(left.is_empty().then_some(()).ok_or(format!("{left:?}")))
        })?;
        Ok(Err("it was started again at once".to_owned()))
    })?;
    ensure!(refusal.status == 503, "{refusal:?}");
    let said = format!("{refusal:?}");
    ensure!(said.contains("times in a row") && said.contains("at the earliest"), "{said}");
    let listed = daemon.deployer().run(&["servants"])?.expect_success()?.output();
    ensure!(listed.contains("next start in"), "{listed}");
    let why = ["explain", "one"];
    let explained = daemon.deployer().run(&why)?.expect_success()?.output();
    ensure!(explained.contains("times in a row"), "{explained}");
    daemon.wait_for_event("the pause", |event| event["kind"] == "servant-back-off")?;
    // Other robots are served, and so is this robot by another revision.
    daemon.robot("adder_py?robot=two")?.call("/add_two", json!({"a": 1, "b": 1}))?;
    daemon.deployer().push("adder_py", &["--node", "adder.py", "--param", "offset=1"])?.expect_success()?;
    daemon.robot("adder_py?robot=one")?.call("/add_two", json!({"a": 1, "b": 1}))?;
    Ok(())
}

pub fn a_killed_daemons_warm_pool_end_without_a_word() -> Verdict {
    let setup = world().setup("warm-pool-killed").config("[servant]\nwarm_memory = \"4M\"\n");
    let daemon = setup.start()?;
    daemon.deployer().push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    let old = wait_for_warm_container(&daemon, &BTreeSet::new())?;
    daemon.kill()?;
    let daemon = setup.start()?;
    let new = wait_for_warm_container(&daemon, &BTreeSet::from([old.clone()]))?;
    ensure!(servant_directories(&daemon)? == BTreeSet::from([new]));
    let events = daemon.deployer().run_json(&["events"])?.to_string();
    ensure!(!events.contains(&old), "{events}");
    Ok(())
}

/// Waits for a warm container other than the known ones; returns its id.
fn wait_for_warm_container(daemon: &Daemon, known: &BTreeSet<String>) -> anyhow::Result<String> {
    support::wait_until("a warm container", || {
        let there = daemon.api("/api/v1/status")?["warm_pool"] == 1;
        let new: Vec<String> = servant_directories(daemon)?.difference(known).cloned().collect();
        Ok(match new.as_slice() {
            [only] if there => Ok(only.clone()),
            _ => Err(format!("{new:?}")),
        })
    })
}

/// Waits for a warm container in which the nodes run.
fn wait_for_warm_nodes(daemon: &Daemon) -> Verdict {
    support::wait_until("a warm container with nodes", || {
        let status = daemon.api("/api/v1/status")?;
        Ok((status["warm_nodes"] == 1).then_some(()).ok_or_else(|| status.to_string()))
    })
}

/// Returns the pids of all processes of this machine.
fn process_ids() -> anyhow::Result<BTreeSet<String>> {
    let entries = fs::read_dir("/proc")?;
    entries.map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned())).collect()
}

fn servant_directories(daemon: &Daemon) -> anyhow::Result<BTreeSet<String>> {
    let entries = fs::read_dir(daemon.home.join("servants"))?;
    entries.map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned())).collect()
}

/// Kills the shim of a servant.
fn kill_shim(daemon: &Daemon, id: &str) -> Verdict {
    let runtime = daemon.home.join("servants").join(id).join("runtime.json");
    let runtime: Value = serde_json::from_slice(&fs::read(runtime)?)?;
    let shim = runtime["shim"]["pid"].as_i64().context("the shim's pid")?;
    Ok(kill(Pid::from_raw(shim as i32), Signal::SIGKILL)?)
}

fn servant_id(daemon: &Daemon, robot: &str) -> anyhow::Result<String> {
    let servant = daemon.servant_of("adder_py", robot)?;
    Ok(servant["id"].as_str().unwrap_or_default().to_owned())
}
