//! Containers made ahead of the robots that use them.

use std::collections::BTreeSet;
use std::fs;

use anyhow::{Context, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::world::world;

pub fn a_robot_takes_the_container_made_ahead_and_another_is_made() -> Verdict {
    let daemon = world().own("warm-pool").start()?;
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
    let runtime: Value = serde_json::from_slice(&fs::read(
        daemon
            .home
            .join("servants")
            .join(&second)
            .join("runtime.json"),
    )?)?;
    let shim = runtime["shim"]["pid"].as_i64().context("the shim's pid")?;
    kill(Pid::from_raw(shim as i32), Signal::SIGKILL)?;
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

pub fn a_killed_daemons_warm_pool_end_without_a_word() -> Verdict {
    let setup = world().own("warm-pool-killed");
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

fn directories(daemon: &Daemon) -> anyhow::Result<BTreeSet<String>> {
    let entries = fs::read_dir(daemon.home.join("servants"))?;
    entries
        .map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()))
        .collect()
}

fn id_of(daemon: &Daemon, robot: &str) -> anyhow::Result<String> {
    let servant = daemon.servant_of("adder_py", robot)?;
    Ok(servant["id"].as_str().unwrap_or_default().to_owned())
}
