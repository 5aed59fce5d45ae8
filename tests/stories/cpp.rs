//! Nodes of ROS 2 in C++, over rcl: a workspace with interfaces, a library, nodes and plugins.

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::robot::Robot;
use support::world::world;

const WORKSPACE: &str = "parrots_ros2";

/// Pushes a node of the workspace as a service, and returns what the service is.
fn push_node(daemon: &Daemon, service: &str, arguments: &[&str]) -> anyhow::Result<Value> {
    let arguments = [&["--name", service][..], arguments].concat();
    daemon.deployer().push(WORKSPACE, &arguments)?.expect_success()?;
    daemon.get_json(&format!("/api/v1/services/{service}"))
}

/// Returns the type of a topic or service in an interface.
fn find_type<'a>(service: &'a Value, part: &str, name: &str) -> anyhow::Result<&'a str> {
    let all = service["interface"][part].as_array().context("a list")?;
    let found = all.iter().find(|one| one["name"] == name);
    found.and_then(|one| one["type"].as_str()).with_context(|| format!("no {name} in {service:#}"))
}

/// Returns what a node publishes on `to` when the robot publishes this text on `from`.
fn answer_to(robot: &mut Robot, [from, to]: [&str; 2], text: &str) -> anyhow::Result<Value> {
    robot.subscribe(to)?;
    robot.send(json!({"op": "advertise", "topic": from, "type": "std_msgs/msg/String"}))?;
    let said = json!({"op": "publish", "topic": from, "msg": {"data": text}});
    let heard = robot.send_until(&said, "an answer", |told| told["op"] == "publish" && told["topic"] == to)?;
    Ok(heard["msg"].clone())
}

pub fn a_node_over_rcl_answers_with_types_of_its_workspace() -> Verdict {
    let daemon = world().ensure_shared()?;
    let service = push_node(&daemon, "parrot", &["--node", "parrots/parrot"])?;
    ensure!(find_type(&service, "topics", "/heard")? == "std_msgs/msg/String");
    ensure!(find_type(&service, "topics", "/repeated")? == "parrot_msgs/msg/Phrase");
    ensure!(find_type(&service, "services", "/recall")? == "parrot_msgs/srv/Recall");
    let mut robot = daemon.robot("parrot?robot=talks")?;
    let repeated = answer_to(&mut robot, ["/heard", "/repeated"], "pretty polly")?;
    ensure!(repeated["words"] == "pretty polly" && repeated["stamp"]["sec"].as_i64() > Some(0), "{repeated}");
    let recalled = robot.call("/recall", json!({"words": "polly"}))?;
    let phrases = &recalled["values"]["phrases"];
    let [phrase] = phrases.as_array().context("a list")?.as_slice() else {
        anyhow::bail!("one phrase, not {recalled}");
    };
    ensure!(phrase["words"] == "pretty polly" && phrase["count"].as_u64() >= Some(1), "{recalled}");
    let recalled = robot.call("/recall", json!({"words": "cracker"}))?;
    ensure!(recalled["values"]["phrases"] == json!([]), "{recalled}");
    robot.leave()
}

pub fn a_library_that_a_parameter_names_is_loaded() -> Verdict {
    let daemon = world().ensure_shared()?;
    let cage = ["--node", "parrots/cage"];
    for (name, parameter, expected) in
        [("cage", &[][..], "polly, polly"), ("cage-loud", &["--param", "voice=loud"], "POLLY!")]
    {
        let service = push_node(&daemon, name, &[&cage[..], parameter].concat())?;
        ensure!(find_type(&service, "topics", "/sung")? == "std_msgs/msg/String");
        let mut robot = daemon.robot(&format!("{name}?robot=listens"))?;
        let sung = answer_to(&mut robot, ["/heard", "/sung"], "polly")?;
        ensure!(sung["data"] == expected, "{sung}");
        robot.leave()?;
    }
    Ok(())
}

pub fn a_lifecycle_node_over_rcl_becomes_active() -> Verdict {
    let daemon = world().ensure_shared()?;
    let service = push_node(&daemon, "owl", &["--node", "parrots/owl"])?;
    ensure!(service["interface"]["lifecycle"] == json!(["/owl"]), "{service:#}");
    // It has them since it was configured.
    ensure!(find_type(&service, "topics", "/hooted")? == "std_msgs/msg/String");
    let mut robot = daemon.robot("owl?robot=wakes")?;
    let hooted = answer_to(&mut robot, ["/seen", "/hooted"], "mouse")?;
    ensure!(hooted["data"] == "hoo, mouse", "{hooted}");
    let servant = daemon.servant_of("owl", "wakes")?;
    ensure!(servant["lifecycle"] == json!([{"node": "/owl", "state": "active"}]), "{servant:#}");
    robot.leave()
}
