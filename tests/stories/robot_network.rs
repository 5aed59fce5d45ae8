//! Robots of ROS 2 that have a network of their own: their stub is on one machine, and on another the application that uses it.

use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use serde_json::{Value, json};
use support::Verdict;
use support::robot_network::{Application, RobotNetwork};
use support::site::{Running, Site};
use support::world::{COURIER, world};

const RCLPY: &str = "letters_rclpy.py";
const CYCLONE: &str = "letters_cyclone.py";
/// Under the name that it has on the robot.
const NODE: &str = "/front/courier";

/// A stub of the courier, with a namespace and a topic that the robot's launch file gives it.
fn stub(network: &RobotNetwork, site: &Site, robot: &str) -> anyhow::Result<Running> {
    let toml = format!(
        "server = \"ws://{}\"\nservice = \"courier_ros2\"\nrobot = \"{robot}\"\nlocal = \"none\"\n",
        network.portal()
    );
    let argv = ["--ros-args", "-r", "__ns:=/front", "-r", "letter:=/letters"];
    site.stub_with(&toml, "courier_ros2", "courier", &argv)
}

/// Does something with a stub's log beside it when it fails.
fn beside<T>(stub: &Running, acts: impl FnOnce() -> anyhow::Result<T>) -> anyhow::Result<T> {
    acts().with_context(|| format!("the stub said:\n{}", stub.said()))
}

fn sees(application: &mut Application, node: &str) -> anyhow::Result<bool> {
    let nodes = application.does("nodes")?;
    let nodes = nodes.as_array().with_context(|| nodes.to_string())?;
    Ok(nodes.iter().any(|one| one == node))
}

/// Topics and calls in both directions, by the names that the original would have there.
fn corresponds(application: &mut Application) -> Verdict {
    for (order, expected) in [
        // What the robot and the node have latched, and what neither has.
        ("send good morning", json!("by sea: good morning")),
        ("home", json!("in the clouds")),
        // A message of 1 MB, there and back.
        ("send_large", json!(true)),
        // A call that the node answers after it has called the robot.
        ("open true", json!([true, "the robot says: as it likes"])),
        ("open false", json!([false, "the robot says: never"])),
    ] {
        let told = application.does(order)?;
        ensure!(told == expected, "{order}: {told}");
    }
    ensure!(sees(application, NODE)? && !sees(application, "/courier")?);
    Ok(())
}

fn is_named_as_the_original(ends: &Value) -> Verdict {
    let string = json!(["std_msgs/msg/String"]);
    for (what, name, of) in [
        ("publishes", "/front/delivered", &string),
        ("publishes", "/front/home", &string),
        ("subscribes", "/letters", &string),
        ("subscribes", "/route", &string),
        ("serves", "/front/open", &json!(["std_srvs/srv/SetBool"])),
    ] {
        ensure!(ends[what][name] == *of, "{what} {name}: {ends:#}");
    }
    Ok(())
}

pub fn another_machine_finds_a_stub_by_multicast() -> Verdict {
    let daemon = world().with(COURIER)?;
    let network = RobotNetwork::new(&daemon.address)?;
    let site = network.robot()?;
    let mut stub = stub(&network, &site, "network-multicast")?;
    let mut application = network.application(RCLPY, &[])?;
    beside(&stub, || {
        corresponds(&mut application)?;
        is_named_as_the_original(&application.does("ends")?)
    })?;
    stub.signal(Signal::SIGINT)?;
    let status = stub.ends()?;
    ensure!(status.code() == Some(0), "{status}: {}", stub.said());
    support::until("a graph without it", || {
        let seen = sees(&mut application, NODE)?;
        Ok(if seen { Err(NODE.to_owned()) } else { Ok(()) })
    })
}

pub fn another_machine_finds_a_stub_by_a_server_that_comes_later_and_again() -> Verdict {
    let daemon = world().with(COURIER)?;
    let network = RobotNetwork::of_server(&daemon.address)?;
    let site = network.robot()?;
    let stub = stub(&network, &site, "network-server")?;
    let mut application = network.application(RCLPY, &[])?;
    beside(&stub, || {
        ensure!(!sees(&mut application, NODE)?, "there is no server yet");
        let server = network.server()?;
        corresponds(&mut application)?;
        // Whoever has found each other goes on without it; nobody else is found.
        server.is_killed()?;
        let told = application.does("send alone")?;
        ensure!(told == "by sea: alone", "{told}");
        let mut late = network.application(RCLPY, &["--ros-args", "-r", "__node:=late"])?;
        ensure!(!sees(&mut late, NODE)?, "the server has ended");
        let _server = network.server()?;
        corresponds(&mut late)?;
        is_named_as_the_original(&late.does("ends")?)?;
        let told = application.does("send again")?;
        ensure!(told == "by sea: again", "{told}");
        Ok(())
    })
}

pub fn another_machine_with_cyclone_dds_finds_a_stub() -> Verdict {
    let daemon = world().with(COURIER)?;
    let network = RobotNetwork::new(&daemon.address)?;
    let site = network.robot()?;
    let stub = stub(&network, &site, "network-cyclone")?;
    let mut application = network.application(CYCLONE, &[])?;
    beside(&stub, || corresponds(&mut application))
}
