//! Restarts of the daemon, which robots only notice as a lost connection.

use std::os::unix::fs::MetadataExt;
use std::path::Path;

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::patience::Deadline;
use support::robot::Robot;

use crate::machine::{HOME, daemon, main_pid, run_program};

/// Directory of locks that show which user ids are in use.
const LOCKS: &str = "/run/cloudroid/uid-ranges";

fn count(robot: &mut Robot) -> anyhow::Result<Option<u64>> {
    let answer = robot.call("/greeter/count", json!({"reset": false}))?;
    Ok(answer["values"]["count"].as_u64())
}

/// Has a name greeted. On this slow machine the node may connect later than publications are kept for it.
fn greet(robot: &mut Robot) -> Verdict {
    let before = count(robot)?;
    robot.send(json!({"op": "advertise", "topic": "/greeter/name", "type": "std_msgs/String"}))?;
    let deadline = Deadline::begin();
    while count(robot)? == before {
        deadline.check(|| "the node hears nothing".to_owned())?;
        robot.send(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": "x"}}))?;
    }
    Ok(())
}

/// Greets before and after `end` ends the daemon, and checks that the same node has counted both.
fn greet_across(robot: &str, end: fn() -> Verdict) -> Verdict {
    let first = daemon()?;
    let path = format!("greeter_cpp?robot={robot}");
    let mut before = first.robot(&path)?;
    greet(&mut before)?;
    let counted = count(&mut before)?;
    let servant = first.servant_of("greeter_cpp", robot)?;
    let old = main_pid()?;
    end()?;
    let second = Daemon::attach(Path::new(HOME), Some(old))?;
    let mut after = second.robot(&path)?;
    // Latched before, and still known to the node.
    after.subscribe("/greeter/greeting")?;
    let latched: Value = after.next_message_on("/greeter/greeting")?;
    ensure!(latched["count"].as_u64() >= counted, "{latched} after {counted:?}");
    greet(&mut after)?;
    ensure!(count(&mut after)? > counted, "the node has counted on");
    let same = second.servant_of("greeter_cpp", robot)?;
    ensure!(
        (&same["id"], &same["pids"], &same["enforced"]) == (&servant["id"], &servant["pids"], &servant["enforced"]),
        "{servant:#} became {same:#}"
    );
    Ok(())
}

pub fn a_killed_daemon_is_started_again_and_finds_its_servants() -> Verdict {
    greet_across("killed", || {
        run_program("systemctl", &["kill", "--kill-whom=main", "-s", "KILL", "cloudroid"]).map(|_| ())
    })
}

pub fn a_restart_loses_nothing() -> Verdict {
    greet_across("restarted", || run_program("systemctl", &["restart", "cloudroid"]).map(|_| ()))
}

/// Returns the first user id of a servant on the host, from the kernel.
fn user_id(daemon: &Daemon, robot: &str) -> anyhow::Result<String> {
    let servant = daemon.servant_of("greeter_cpp", robot)?;
    let pid = servant["pids"].as_array().and_then(|pids| pids.first()).and_then(Value::as_i64).context("a process")?;
    let map = std::fs::read_to_string(format!("/proc/{pid}/uid_map"))?;
    let first = map.split_whitespace().nth(1).context("a user id")?;
    Ok(first.to_owned())
}

pub fn after_a_restart_of_the_unit_no_two_servants_have_the_same_user_ids() -> Verdict {
    let first = daemon()?;
    let mut before = first.robot("greeter_cpp?robot=older")?;
    count(&mut before)?;
    let locks = std::fs::metadata(LOCKS)?.ino();
    let old = main_pid()?;
    // Stopped and started like in a package upgrade, during which the directory below /run would disappear.
    run_program("systemctl", &["stop", "cloudroid"])?;
    ensure!(
        std::fs::metadata(LOCKS).is_ok_and(|kept| kept.ino() == locks),
        "the locks of servants that go on were removed"
    );
    run_program("systemctl", &["start", "cloudroid"])?;
    let second = Daemon::attach(Path::new(HOME), Some(old))?;
    let mut after = second.robot("greeter_cpp?robot=newer")?;
    count(&mut after)?;
    let (older, newer) = (user_id(&second, "older")?, user_id(&second, "newer")?);
    ensure!(older != newer, "both servants have {older} for their root");
    Ok(())
}
