//! The daemon ends and begins again; robots notice no more than a lost connection.

use std::path::Path;

use anyhow::ensure;
use serde_json::json;
use support::Told;
use support::daemon::Daemon;

use crate::machine::{HOME, daemon, main_pid, types};

/// Greets twice, has the daemon end in between by `end`, and finds the node that counted.
fn counted_over(robot: &str, end: fn() -> Told) -> Told {
    let first = daemon()?;
    let path = format!("greeter_cpp?robot={robot}");
    let mut before = first.robot(&path)?;
    before.subscribes("/greeter/greeting")?;
    before.says(json!({"op": "advertise", "topic": "/greeter/name", "type": "std_msgs/String"}))?;
    before.awaits_subscriber("/greeter/name")?;
    before.says(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": "one"}}))?;
    ensure!(before.hears_on("/greeter/greeting")?["count"] == 1);
    let servant = first.servant_of("greeter_cpp", robot)?;
    let old = main_pid()?;
    end()?;
    let second = Daemon::of_another(Path::new(HOME), Some(old))?;
    let mut after = second.robot(&path)?;
    // Latched before, and still known to the node.
    after.subscribes("/greeter/greeting")?;
    ensure!(after.hears_on("/greeter/greeting")?["count"] == 1);
    after.says(json!({"op": "advertise", "topic": "/greeter/name", "type": "std_msgs/String"}))?;
    after.awaits_subscriber("/greeter/name")?;
    after.says(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": "two"}}))?;
    ensure!(
        after.hears_on("/greeter/greeting")?["count"] == 2,
        "the node has counted on"
    );
    let same = second.servant_of("greeter_cpp", robot)?;
    ensure!(
        (&same["id"], &same["pids"], &same["enforced"])
            == (&servant["id"], &servant["pids"], &servant["enforced"]),
        "{servant:#} became {same:#}"
    );
    Ok(())
}

pub fn a_killed_daemon_is_started_again_and_finds_its_servants() -> Told {
    counted_over("killed", || {
        types(
            "systemctl",
            &["kill", "--kill-whom=main", "-s", "KILL", "cloudroid"],
        )
        .map(|_| ())
    })
}

pub fn a_restart_loses_nothing() -> Told {
    counted_over("restarted", || {
        types("systemctl", &["restart", "cloudroid"]).map(|_| ())
    })
}
