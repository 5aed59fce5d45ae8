//! Nodes that run but do not respond.

use anyhow::{Context, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::json;
use support::Verdict;
use support::patience::scale_seconds;
use support::world::world;

pub fn a_node_that_answers_no_more_is_told_and_started_again() -> Verdict {
    let setup = world().setup("hung").config("[servant]\nhung = \"restart\"\nhung_after = 2\nwarm_nodes = 1\n");
    let daemon = setup.start()?;
    daemon.deployer().push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    support::wait_until("a container whose node runs", || {
        let status = daemon.api("/api/v1/status")?;
        Ok((status["warm_nodes"] == 1).then_some(()).ok_or_else(|| status.to_string()))
    })?;
    // A node counts as hanging after twice this time: long enough that it does not count so before it is stopped, and
    // that the bridge meanwhile finds that it cannot connect.
    let rrt = scale_seconds(1).max(6);
    let mut robot = daemon.robot(&format!("adder_py?robot=one&rrt={rrt}s"))?;
    let sum = json!({"a": 1, "b": 1});
    robot.call("/add_two", sum.clone())?;
    let servant = daemon.servant_of("adder_py", "one")?;
    let pids = servant["pids"].as_array().context("pids")?;
    ensure!(!pids.is_empty(), "it runs: {servant}");
    for pid in pids {
        let pid = pid.as_i64().context("a pid")?;
        kill(Pid::from_raw(pid as i32), Signal::SIGSTOP)?;
    }
    // Inputs flow until it is reported.
    let mut asked = 0;
    let message = support::wait_until("word of the node", || {
        asked += 1;
        robot.send(json!({"op": "call_service", "id": asked.to_string(), "service": "/add_two", "args": sum}))?;
        let events = daemon.api("/api/v1/events?limit=10000")?;
        let told = events.as_array().context("a list")?.iter();
        let mut told = told.filter(|event| event["kind"] == "node-hung");
        let message = told.next().map(|event| event["message"].to_string());
        Ok(message.ok_or_else(|| events.to_string()))
    })?;
    ensure!(message.contains("/adder answered none of"), "{message}");
    robot.wait_for_status("/adder answered none of")?;
    daemon.wait_for_event("its new start", |event| event["kind"] == "node-failed")?;
    support::wait_until("an answer", || {
        let answer = robot.call("/add_two", sum.clone())?;
        Ok((answer["values"]["sum"] == 2).then_some(()).ok_or_else(|| answer.to_string()))
    })?;
    ensure!(daemon.servant_of("adder_py", "one")?["id"] == servant["id"]);
    Ok(())
}
