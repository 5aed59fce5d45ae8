//! Nodes that run and answer nobody.

use anyhow::{Context, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::json;
use support::Verdict;
use support::patience::scale_seconds;
use support::world::world;

pub fn a_node_that_answers_no_more_is_told_and_started_again() -> Verdict {
    let setup = world()
        .own("hung")
        .config("[servant]\nhung = \"restart\"\nhung_after = 2\nwarm_nodes = 1\n");
    let daemon = setup.start()?;
    daemon
        .deployer()
        .pushes("adder_py", &["--node", "adder.py"])?
        .succeeded()?;
    support::until("a container whose node runs", || {
        let status = daemon.api("/api/v1/status")?;
        Ok((status["warm_nodes"] == 1)
            .then_some(())
            .ok_or_else(|| status.to_string()))
    })?;
    // Twice as long it hangs: before it is stopped it is not to be taken for that, and meanwhile the bridge finds that it cannot connect.
    let rrt = scale_seconds(1).max(6);
    let mut robot = daemon.robot(&format!("adder_py?robot=one&rrt={rrt}s"))?;
    let sum = json!({"a": 1, "b": 1});
    robot.calls("/add_two", sum.clone())?;
    let servant = daemon.servant_of("adder_py", "one")?;
    let pids = servant["pids"].as_array().context("pids")?;
    ensure!(!pids.is_empty(), "it runs: {servant}");
    for pid in pids {
        let pid = pid.as_i64().context("a pid")?;
        kill(Pid::from_raw(pid as i32), Signal::SIGSTOP)?;
    }
    // Inputs flow until it is told.
    let mut asked = 0;
    let message = support::until("word of the node", || {
        asked += 1;
        robot.says(json!({"op": "call_service", "id": asked.to_string(), "service": "/add_two", "args": sum}))?;
        let events = daemon.api("/api/v1/events?limit=10000")?;
        let told = events.as_array().context("a list")?.iter();
        let mut told = told.filter(|event| event["kind"] == "node-hung");
        let message = told.next().map(|event| event["message"].to_string());
        Ok(message.ok_or_else(|| events.to_string()))
    })?;
    ensure!(message.contains("/adder answered none of"), "{message}");
    robot.hears_status("/adder answered none of")?;
    daemon.awaits_event("its new start", |event| event["kind"] == "node-failed")?;
    support::until("an answer", || {
        let answer = robot.calls("/add_two", sum.clone())?;
        Ok((answer["values"]["sum"] == 2)
            .then_some(())
            .ok_or_else(|| answer.to_string()))
    })?;
    ensure!(daemon.servant_of("adder_py", "one")?["id"] == servant["id"]);
    Ok(())
}
