//! Containers made ahead of the robots that use them.

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
    let setup = world().own("warm-pool");
    let daemon = setup.config("[servant]\nwarm_memory = \"4M\"\n").start()?;
    daemon
        .deployer()
        .pushes("adder_py", &["--node", "adder.py"])?
        .succeeded()?;
    let first = warm(&daemon, &BTreeSet::new())?;
    ensure!(
        daemon.servants_of("adder_py")?.is_empty(),
        "a warm container is nobody's servant"
    );
    let mut one = daemon.robot("adder_py?robot=one")?;
    one.calls("/add_two", json!({"a": 1, "b": 1}))?;
    ensure!(
        id_of(&daemon, "one")? == first,
        "the warm container was used"
    );

    let second = warm(&daemon, &BTreeSet::from([first.clone()]))?;
    // A warm container that dies is no reason to keep a robot waiting for it.
    kills(&daemon, &second)?;
    let mut two = daemon.robot("adder_py?robot=two")?;
    two.calls("/add_two", json!({"a": 2, "b": 2}))?;
    one.calls("/add_two", json!({"a": 3, "b": 3}))?;

    daemon.deployer().types(&["rm", "adder_py"])?.succeeded()?;
    ensure!(
        directories(&daemon)?.is_empty(),
        "left: {:?}",
        directories(&daemon)?
    );
    Ok(())
}

pub fn a_robot_takes_a_servant_whose_nodes_run() -> Verdict {
    let setup = world()
        .own("warm-nodes")
        .config("[capacity]\ncpus = 2\n[servant]\nwarm_nodes = 1\nreserve_cpus = 1.0\n");
    let daemon = setup.start()?;
    daemon
        .deployer()
        .pushes("adder_py", &["--node", "adder.py"])?
        .succeeded()?;
    nodes_run(&daemon)?;
    let promised = daemon.api("/api/v1/status")?["capacity"]["cpus_reserved"].clone();
    ensure!(promised == 1.0, "{promised} cores are promised to it");
    let before = processes()?;
    let mut one = daemon.robot("adder_py?robot=one")?;
    let answer = one.calls("/add_two", json!({"a": 1, "b": 1}))?;
    ensure!(answer["values"]["sum"] == 2, "{answer}");
    let servant = daemon.servant_of("adder_py", "one")?;
    let pids = servant["pids"].as_array().context("pids")?;
    ensure!(
        !pids.is_empty() && pids.iter().all(|pid| before.contains(&pid.to_string())),
        "its node was started for it: {servant}"
    );
    let told = daemon.deployer().asks(&["events"])?.to_string();
    ensure!(!told.contains("~warm"), "it is somebody's now: {told}");

    // Another is ready beside it. It ends as soon as somebody needs its capacity.
    nodes_run(&daemon)?;
    let other = ["--name", "other", "--node", "adder.py"];
    daemon.deployer().pushes("adder_py", &other)?.succeeded()?;
    let mut two = daemon.robot("other?robot=two")?;
    let answer = two.calls("/add_two", json!({"a": 2, "b": 2}))?;
    ensure!(answer["values"]["sum"] == 4, "{answer}");
    one.calls("/add_two", json!({"a": 3, "b": 3}))?;

    // What is ready for nobody is nobody's after the daemon's death, too.
    daemon.deployer().types(&["stop", "--all"])?.succeeded()?;
    nodes_run(&daemon)?;
    let left = directories(&daemon)?;
    daemon.is_killed()?;
    let daemon = setup.start()?;
    nodes_run(&daemon)?;
    // Robots are served first: what the killed daemon kept ready ends beside that.
    support::until("the end of what nobody knows the state of", || {
        let still: Vec<_> = directories(&daemon)?.intersection(&left).cloned().collect();
        Ok(if still.is_empty() {
            Ok(())
        } else {
            Err(format!("{still:?} are there"))
        })
    })?;
    let told = daemon.deployer().asks(&["events"])?.to_string();
    ensure!(
        !told.contains("servant-lost") && !told.contains("servant-unknown"),
        "{told}"
    );
    Ok(())
}

pub fn a_service_that_fails_again_and_again_says_when_it_is_tried() -> Verdict {
    let daemon = world().own("back-off").start()?;
    daemon
        .deployer()
        .pushes("adder_py", &["--node", "adder.py"])?
        .succeeded()?;
    // Pauses grow until one is longer than it takes to ask again, however slow this machine is.
    let refusal = support::until("a refusal", || {
        let mut robot = match Robot::try_connect(&daemon.url("adder_py?robot=one")) {
            Ok(robot) => robot,
            Err(refusal) => return Ok(Ok(refusal)),
        };
        robot.calls("/add_two", json!({"a": 1, "b": 1}))?;
        kills(&daemon, &id_of(&daemon, "one")?)?;
        robot.hears_close()?;
        support::until("the servant's end", || {
            let left = daemon.servants_of("adder_py")?;
            Ok(left.is_empty().then_some(()).ok_or(format!("{left:?}")))
        })?;
        Ok(Err("it was started again at once".to_owned()))
    })?;
    ensure!(refusal.status == 503, "{refusal:?}");
    let said = format!("{refusal:?}");
    ensure!(
        said.contains("times in a row") && said.contains("at the earliest"),
        "{said}"
    );
    let listed = daemon.deployer().types(&["servants"])?.succeeded()?.said();
    ensure!(listed.contains("next start in"), "{listed}");
    let why = ["explain", "one"];
    let explained = daemon.deployer().types(&why)?.succeeded()?.said();
    ensure!(explained.contains("times in a row"), "{explained}");
    daemon.awaits_event("the pause", |event| event["kind"] == "servant-back-off")?;
    // Others are served, and so is the robot by another revision.
    daemon
        .robot("adder_py?robot=two")?
        .calls("/add_two", json!({"a": 1, "b": 1}))?;
    daemon
        .deployer()
        .pushes("adder_py", &["--node", "adder.py"])?
        .succeeded()?;
    daemon
        .robot("adder_py?robot=one")?
        .calls("/add_two", json!({"a": 1, "b": 1}))?;
    Ok(())
}

pub fn a_killed_daemons_warm_pool_end_without_a_word() -> Verdict {
    let setup = world()
        .own("warm-pool-killed")
        .config("[servant]\nwarm_memory = \"4M\"\n");
    let daemon = setup.start()?;
    daemon
        .deployer()
        .pushes("adder_py", &["--node", "adder.py"])?
        .succeeded()?;
    let old = warm(&daemon, &BTreeSet::new())?;
    daemon.is_killed()?;
    let daemon = setup.start()?;
    let new = warm(&daemon, &BTreeSet::from([old.clone()]))?;
    ensure!(directories(&daemon)? == BTreeSet::from([new]));
    let events = daemon.deployer().asks(&["events"])?.to_string();
    ensure!(!events.contains(&old), "{events}");
    Ok(())
}

/// Waits for a warm container besides those known; its id.
fn warm(daemon: &Daemon, known: &BTreeSet<String>) -> anyhow::Result<String> {
    support::until("a warm container", || {
        let there = daemon.api("/api/v1/status")?["warm_pool"] == 1;
        let new: Vec<String> = directories(daemon)?.difference(known).cloned().collect();
        Ok(match new.as_slice() {
            [only] if there => Ok(only.clone()),
            _ => Err(format!("{new:?}")),
        })
    })
}

/// Waits for a warm container in which the nodes run.
fn nodes_run(daemon: &Daemon) -> Verdict {
    support::until("a warm container with nodes", || {
        let status = daemon.api("/api/v1/status")?;
        Ok((status["warm_nodes"] == 1)
            .then_some(())
            .ok_or_else(|| status.to_string()))
    })
}

/// Ids of all processes of this machine.
fn processes() -> anyhow::Result<BTreeSet<String>> {
    let entries = fs::read_dir("/proc")?;
    entries
        .map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()))
        .collect()
}

fn directories(daemon: &Daemon) -> anyhow::Result<BTreeSet<String>> {
    let entries = fs::read_dir(daemon.home.join("servants"))?;
    entries
        .map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()))
        .collect()
}

/// Kills the parent of a servant's processes.
fn kills(daemon: &Daemon, id: &str) -> Verdict {
    let runtime = daemon.home.join("servants").join(id).join("runtime.json");
    let runtime: Value = serde_json::from_slice(&fs::read(runtime)?)?;
    let shim = runtime["shim"]["pid"].as_i64().context("the shim's pid")?;
    Ok(kill(Pid::from_raw(shim as i32), Signal::SIGKILL)?)
}

fn id_of(daemon: &Daemon, robot: &str) -> anyhow::Result<String> {
    let servant = daemon.servant_of("adder_py", robot)?;
    Ok(servant["id"].as_str().unwrap_or_default().to_owned())
}
