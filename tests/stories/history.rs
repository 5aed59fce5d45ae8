//! History of servants and the machine.

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::world::world;

use crate::access::create_token;

pub fn what_servants_did_outlives_them_and_the_daemon() -> Verdict {
    let setup = world().setup("history");
    let daemon = setup.start()?;
    let deployer = daemon.deployer();
    deployer.push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    let mut robot = daemon.robot("adder_py?robot=r1&rrt=100ms&max_rrt=2s")?;
    // Repeated calls, because a sample covers the ten seconds before it.
    let history = support::wait_until("a sample with response times", || {
        let sum = robot.call("/add_two", json!({"a": 2, "b": 3}))?;
        ensure!(sum["values"]["sum"] == 5, "{sum}");
        let history = daemon.api("/api/v1/history/servants?robot=r1&step=10")?;
        let answered = history[0]["figures"]["p50"].as_array().is_some_and(|all| all.iter().any(Value::is_f64));
        Ok(if answered { Ok(history) } else { Err(history.to_string()) })
    })?;
    let one = &history[0];
    ensure!(one["service"] == "adder_py" && one["step"] == 10, "{one:#}");
    let figures = one["figures"].as_object().context("figures")?;
    let times = figures["time"].as_array().context("times")?;
    for (name, list) in figures {
        let length = list.as_array().context("a list")?.len();
        ensure!(length == times.len(), "{name}: {one:#}");
    }
    let last = |name: &str| figures[name].as_array().and_then(|all| all.last()?.as_f64());
    ensure!(last("memory") > Some(1e6) && last("desire") == Some(100.0) && last("max") == Some(2000.0), "{one:#}");
    let machine = daemon.api("/api/v1/history/machine?step=10")?;
    let memory = machine["figures"]["memory"].as_array().context("memory")?;
    ensure!(memory.iter().any(|one| one.as_f64() > Some(1e6)), "{machine:#}");

    robot.call("/add_two", json!({"a": -2, "b": 0}))?;
    // After a kill and restart the history is still available, also for a servant that has ended.
    robot.leave()?;
    daemon.kill()?;
    let daemon = setup.start()?;
    daemon.deployer().run(&["stop", "--all"])?.expect_success()?;
    ensure!(daemon.servants_of("adder_py")?.is_empty());
    let id = one["servant"].as_str().context("an id")?;
    let later = daemon.api(&format!("/api/v1/history/servants?servant={id}&step=10"))?;
    let kept = later[0]["figures"]["time"].as_array().context("times")?;
    ensure!(kept.starts_with(times) && later[0]["robot"] == "r1", "{later:#}\n{one:#}");
    let none = daemon.api(&format!(
        "/api/v1/history/servants?servant={id}&step=10&to={}",
        times[0].as_u64().context("a time")? - 1
    ))?;
    ensure!(none[0]["figures"]["time"] == json!([]), "{none:#}");

    // So is what it printed, after another restart.
    daemon.kill()?;
    let daemon = setup.start()?;
    let deployer = daemon.deployer();
    deployer.run(&["logs", "adder_py"])?.expect_failure(&["it was stopped: cloudroidctl logs --previous adder_py"])?;
    for name in ["adder_py", "r1", id] {
        let log = deployer.run(&["logs", name, "--previous", "--since", "12h", "-t"])?.expect_success()?;
        let warning = log.stdout.lines().find(|line| line.contains("the sum is negative: -2"));
        // Date and time, as far as they are surely the same.
        ensure!(warning.is_some_and(|line| line.starts_with("20") && line.contains("Z /adder | ")), "{}", log.output());
    }
    let log = deployer.run(&["logs", id, "--since", "2100-01-01"])?.expect_success()?;
    ensure!(log.stdout.is_empty(), "{}", log.output());
    let log = deployer.run(&["--format", "json", "logs", id])?.expect_success()?;
    let warning = log.stdout.lines().find(|line| line.contains("the sum is negative: -2"));
    ensure!(warning.is_some_and(|line| line.contains("\"level\":\"warn\"")), "{}", log.output());

    // Principals see the history that they may see.
    let viewer = ["looks", "--role", "viewer", "--service", "adder*"];
    let viewer = create_token(&daemon, &viewer)?;
    let stranger = ["far", "--role", "viewer", "--service", "other*"];
    let stranger = create_token(&daemon, &stranger)?;
    let another = ["r2", "--role", "robot", "--robot", "r2", "--service", "*"];
    let another = create_token(&daemon, &another)?;
    for (token, count) in [(viewer, 1), (stranger, 0), (another, 0)] {
        let bearer = format!("Bearer {token}");
        let asks = |path: &str| daemon.request("GET", path, &[("Authorization", &bearer)]);
        let (status, body) = asks("/api/v1/history/servants")?;
        let seen: Vec<Value> = serde_json::from_str(&body)?;
        ensure!(status == 200 && seen.len() == count, "{status} {body}");
        let (status, body) = asks("/api/v1/history/servants?servant=")?;
        ensure!((status, &*body) == (200, "[]"), "{status} {body}");
        let (status, body) = asks("/api/v1/logs")?;
        ensure!((status, &*body) == (200, "[]"), "{status} {body}");
        for refused in ["/api/v1/history/machine", &*format!("/api/v1/servants/{id}/logs")] {
            let (status, body) = asks(refused)?;
            ensure!(status == 403, "{status} {body}");
        }
    }
    // Invalid requests are refused with the name of the error.
    let admin = create_token(&daemon, &["boss", "--role", "admin"])?;
    let bearer = format!("Bearer {admin}");
    for (asked, words) in
        [("step=7", "step=10"), ("from=2&to=1", "from is after to"), ("from=yesterday", "query"), ("to=-1", "query")]
    {
        let path = format!("/api/v1/history/servants?{asked}");
        let (status, body) = daemon.request("GET", &path, &[("Authorization", &bearer)])?;
        ensure!(status == 400 && body.contains(words), "{asked}: {status} {body}");
    }
    // Whoever pushes a service of this name next finds nothing of it.
    ensure!(daemon.home.join("ended").join(id).is_dir());
    daemon.deployer().run(&["rm", "adder_py"])?.expect_success()?;
    ensure!(!daemon.home.join("ended").join(id).exists());
    daemon.deployer().run(&["logs", id, "--previous"])?.expect_failure(&["no log of an ended servant"])?;
    Ok(())
}
