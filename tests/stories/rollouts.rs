//! Replacing revisions while robots work.

use anyhow::ensure;
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::robot::Robot;
use support::world::world;

pub fn a_canary_that_fails_is_taken_back_and_its_robot_goes_on() -> Verdict {
    let setup = world().setup("rollouts");
    let daemon = setup.start()?;
    push(&daemon, &[])?;
    let mut old = connect_to_revision(&daemon, "old", 1)?;
    // It adds a number and a string, which fails in Python.
    let terms = ["--param", "offset=oops", "--canary", "1", "--samples", "5"];
    push(&daemon, &terms)?;
    let first = connect_to_revision(&daemon, "first", 2)?;
    let mut second = connect_to_revision(&daemon, "second", 1)?;
    ensure!(request_sum(&mut second)? == 2);

    // The next daemon remembers which robots have the canary.
    drop((old, first, second));
    daemon.kill()?;
    let daemon = setup.start()?;
    let shown = daemon.deployer().run_json(&["rollout", "adder_py"])?;
    ensure!(shown["state"] == "canary" && shown["candidate"] == 2, "{shown}");
    old = connect_to_revision(&daemon, "old", 1)?;
    let mut first = connect_to_revision(&daemon, "first", 2)?;
    let taken_back = |daemon: &Daemon| -> anyhow::Result<bool> {
        let shown = daemon.deployer().run_json(&["rollout", "adder_py"])?;
        Ok(shown["state"] == "rolled-back")
    };
    support::wait_until("the canary's end", || {
        if taken_back(&daemon)? {
            return Ok(Ok(()));
        }
        ensure!(request_sum(&mut old)? == 2);
        // Its servant ends with the canary.
        if let Ok(answer) = first.call("/add_two", json!({"a": 1, "b": 1})) {
            ensure!(answer["result"] == false, "a number and a word: {answer}");
        }
        Ok(Err("it serves its robot".to_owned()))
    })?;
    let event = daemon.wait_for_event("why", |event| event["kind"] == "rollout-rolled-back")?;
    let why = event["message"].as_str().unwrap_or_default();
    ensure!(why.contains("requests failed"), "{why}");
    let mut first = connect_to_revision(&daemon, "first", 1)?;
    ensure!(request_sum(&mut first)? == 2 && request_sum(&mut old)? == 2);
    connect_to_revision(&daemon, "third", 1)?;
    let promote = ["rollout", "adder_py", "promote"];
    daemon.deployer().run(&promote)?.expect_failure(&["revision 2 of adder_py is not a canary"])?;
    Ok(())
}

pub fn a_canary_is_promoted_and_robots_keep_what_they_have_until_the_deadline() -> Verdict {
    let daemon = world().setup("rollouts-promoted").start()?;
    push(&daemon, &[])?;
    let mut old = connect_to_revision(&daemon, "old", 1)?;
    let terms = ["--param", "offset=100", "--canary", "1", "--deadline", "1s"];
    push(&daemon, &terms)?;
    let mut first = connect_to_revision(&daemon, "first", 2)?;
    ensure!(request_sum(&mut first)? == 102);
    connect_to_revision(&daemon, "second", 1)?;
    ensure!(request_sum(&mut old)? == 2, "it keeps what it has");
    let promote = ["rollout", "adder_py", "promote"];
    daemon.deployer().run(&promote)?.expect_success()?;
    connect_to_revision(&daemon, "third", 2)?;
    let close = old.wait_for_close()?;
    ensure!(close.reason.contains("deadline"), "{close:?}");
    let mut old = connect_to_revision(&daemon, "old", 2)?;
    ensure!(request_sum(&mut old)? == 102);
    ensure!(request_sum(&mut first)? == 102, "the canary's robot goes on");

    // An incompatible revision is not tried on robots.
    let other = ["--remap", "/add_two:=/sum_two", "--canary", "50%"];
    let arguments = [["--node", "adder.py"].as_slice(), &other].concat();
    daemon.deployer().push("adder_py", &arguments)?.expect_failure(&["cannot be a canary", "/add_two"])?;
    connect_to_revision(&daemon, "fourth", 2)?;
    Ok(())
}

fn push(daemon: &Daemon, more: &[&str]) -> Verdict {
    let arguments = [["--node", "adder.py"].as_slice(), more].concat();
    let pushed = daemon.deployer().push("adder_py", &arguments)?;
    pushed.expect_success().map(|_| ())
}

/// Connects a robot and checks that its servant has this revision.
fn connect_to_revision(daemon: &Daemon, name: &str, revision: u64) -> anyhow::Result<Robot> {
    let mut robot = daemon.robot(&format!("adder_py?robot={name}"))?;
    robot.call("/rosapi/nodes", json!({}))?;
    let servants = daemon.servants_of("adder_py")?;
    let is_its = |it: &Value| it["robot"] == name && it["phase"] == "ready";
    let found = servants.iter().find(|it| is_its(it));
    ensure!(
        found.is_some_and(|servant| servant["revision"] == revision),
        "{name} has no servant of revision {revision}: {servants:?}"
    );
    Ok(robot)
}

fn request_sum(robot: &mut Robot) -> anyhow::Result<i64> {
    let answer = robot.call("/add_two", json!({"a": 1, "b": 1}))?;
    Ok(answer["values"]["sum"].as_i64().unwrap_or_default())
}
