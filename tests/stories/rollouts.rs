//! Revisions that take each other's place while robots work.

use anyhow::ensure;
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::robot::Robot;
use support::world::world;

pub fn a_canary_that_fails_is_taken_back_and_its_robot_goes_on() -> Verdict {
    let setup = world().own("rollouts");
    let daemon = setup.start()?;
    pushes(&daemon, &[])?;
    let mut old = robot(&daemon, "old", 1)?;
    // It adds a number and a word, which Python refuses.
    let terms = ["--param", "offset=oops", "--canary", "1", "--samples", "5"];
    pushes(&daemon, &terms)?;
    let first = robot(&daemon, "first", 2)?;
    let mut second = robot(&daemon, "second", 1)?;
    ensure!(sum(&mut second)? == 2);

    // The next daemon knows who has the canary.
    drop((old, first, second));
    daemon.is_killed()?;
    let daemon = setup.start()?;
    let shown = daemon.deployer().asks(&["rollout", "adder_py"])?;
    ensure!(
        shown["state"] == "canary" && shown["candidate"] == 2,
        "{shown}"
    );
    old = robot(&daemon, "old", 1)?;
    let mut first = robot(&daemon, "first", 2)?;
    let taken_back = |daemon: &Daemon| -> anyhow::Result<bool> {
        let shown = daemon.deployer().asks(&["rollout", "adder_py"])?;
        Ok(shown["state"] == "rolled-back")
    };
    support::until("the canary's end", || {
        if taken_back(&daemon)? {
            return Ok(Ok(()));
        }
        ensure!(sum(&mut old)? == 2);
        // Its servant ends with the canary.
        if let Ok(answer) = first.calls("/add_two", json!({"a": 1, "b": 1})) {
            ensure!(answer["result"] == false, "a number and a word: {answer}");
        }
        Ok(Err("it serves its robot".to_owned()))
    })?;
    let event = daemon.awaits_event("why", |event| event["kind"] == "rollout-rolled-back")?;
    let why = event["message"].as_str().unwrap_or_default();
    ensure!(why.contains("requests failed"), "{why}");
    let mut first = robot(&daemon, "first", 1)?;
    ensure!(sum(&mut first)? == 2 && sum(&mut old)? == 2);
    robot(&daemon, "third", 1)?;
    let promote = ["rollout", "adder_py", "promote"];
    daemon
        .deployer()
        .types(&promote)?
        .failed_saying(&["revision 2 of adder_py is no canary"])?;
    Ok(())
}

pub fn a_canary_is_promoted_and_robots_keep_what_they_have_until_the_deadline() -> Verdict {
    let daemon = world().own("rollouts-promoted").start()?;
    pushes(&daemon, &[])?;
    let mut old = robot(&daemon, "old", 1)?;
    let terms = ["--param", "offset=100", "--canary", "1", "--deadline", "1s"];
    pushes(&daemon, &terms)?;
    let mut first = robot(&daemon, "first", 2)?;
    ensure!(sum(&mut first)? == 102);
    robot(&daemon, "second", 1)?;
    ensure!(sum(&mut old)? == 2, "it keeps what it has");
    let promote = ["rollout", "adder_py", "promote"];
    daemon.deployer().types(&promote)?.succeeded()?;
    robot(&daemon, "third", 2)?;
    let close = old.hears_close()?;
    ensure!(close.reason.contains("deadline"), "{close:?}");
    let mut old = robot(&daemon, "old", 2)?;
    ensure!(sum(&mut old)? == 102);
    ensure!(sum(&mut first)? == 102, "the canary's robot goes on");

    // What would break a robot is not tried on one.
    let other = ["--remap", "/add_two:=/sum_two", "--canary", "50%"];
    let arguments = [["--node", "adder.py"].as_slice(), &other].concat();
    daemon
        .deployer()
        .pushes("adder_py", &arguments)?
        .failed_saying(&["cannot be a canary", "/add_two"])?;
    robot(&daemon, "fourth", 2)?;
    Ok(())
}

fn pushes(daemon: &Daemon, more: &[&str]) -> Verdict {
    let arguments = [["--node", "adder.py"].as_slice(), more].concat();
    let pushed = daemon.deployer().pushes("adder_py", &arguments)?;
    pushed.succeeded().map(|_| ())
}

/// A robot whose servant is of this revision.
fn robot(daemon: &Daemon, name: &str, revision: u64) -> anyhow::Result<Robot> {
    let mut robot = daemon.robot(&format!("adder_py?robot={name}"))?;
    robot.calls("/rosapi/nodes", json!({}))?;
    let servants = daemon.servants_of("adder_py")?;
    let is_its = |it: &Value| it["robot"] == name && it["phase"] == "ready";
    let found = servants.iter().find(|it| is_its(it));
    ensure!(
        found.is_some_and(|servant| servant["revision"] == revision),
        "{name} has no servant of revision {revision}: {servants:?}"
    );
    Ok(robot)
}

fn sum(robot: &mut Robot) -> anyhow::Result<i64> {
    let answer = robot.calls("/add_two", json!({"a": 1, "b": 1}))?;
    Ok(answer["values"]["sum"].as_i64().unwrap_or_default())
}
