//! Robots of ROS 2 with a network of their own: the stub runs on one machine, and the application that uses it on
//! another.

use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use serde_json::{Value, json};
use support::Verdict;
use support::robot_network::{RobotNetwork, RobotProgram};
use support::site::{NodeProcess, Site};
use support::world::{COURIER, world};

const RCLPY: &str = "letters_rclpy.py";
const CYCLONE: &str = "letters_cyclone.py";
/// Name of the node on the robot.
const NODE: &str = "/front/courier";

/// Starts a stub of the courier, with a namespace and a remapping as in a robot's launch file.
fn start_stub(network: &RobotNetwork, site: &Site, robot: &str) -> anyhow::Result<NodeProcess> {
    let toml = format!(
        "server = \"ws://{}\"\nservice = \"courier_ros2\"\nrobot = \"{robot}\"\nlocal = \"none\"\n",
        network.portal()
    );
    let argv = ["--ros-args", "-r", "__ns:=/front", "-r", "letter:=/letters"];
    site.start_stub_with_config(&toml, "courier_ros2", "courier", &argv)
}

/// Adds the stub's log to an error.
fn with_stub_log<T>(stub: &NodeProcess, acts: impl FnOnce() -> anyhow::Result<T>) -> anyhow::Result<T> {
    acts().with_context(|| format!("the stub said:\n{}", stub.output()))
}

fn sees_node(application: &mut RobotProgram, node: &str) -> anyhow::Result<bool> {
    let nodes = application.send_order("nodes")?;
    let nodes = nodes.as_array().with_context(|| nodes.to_string())?;
    Ok(nodes.iter().any(|one| one == node))
}

/// Checks topics and calls in both directions, with the names of the original.
fn expect_correspondence(application: &mut RobotProgram) -> Verdict {
    for (order, expected) in [
        // Messages latched by the robot and by the node, and a topic without one.
        ("send good morning", json!("by sea: good morning")),
        ("home", json!("in the clouds")),
        // A message of 1 MB in both directions.
        ("send_large", json!(true)),
        // A call that the node answers after calling the robot.
        ("open true", json!([true, "the robot says: as it likes"])),
        ("open false", json!([false, "the robot says: never"])),
    ] {
        let told = application.send_order(order)?;
        ensure!(told == expected, "{order}: {told}");
    }
    ensure!(sees_node(application, NODE)? && !sees_node(application, "/courier")?);
    Ok(())
}

fn expect_original_names(ends: &Value) -> Verdict {
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
    let daemon = world().daemon_with(COURIER)?;
    let network = RobotNetwork::new(&daemon.address)?;
    let site = network.robot()?;
    let mut stub = start_stub(&network, &site, "network-multicast")?;
    let mut application = network.start_application(RCLPY, &[])?;
    with_stub_log(&stub, || {
        expect_correspondence(&mut application)?;
        expect_original_names(&application.send_order("ends")?)
    })?;
    stub.signal(Signal::SIGINT)?;
    let status = stub.wait_for_exit()?;
    ensure!(status.code() == Some(0), "{status}: {}", stub.output());
    support::wait_until("a graph without it", || {
        let seen = sees_node(&mut application, NODE)?;
        Ok(if seen { Err(NODE.to_owned()) } else { Ok(()) })
    })
}

pub fn another_machine_finds_a_stub_by_a_server_that_comes_later_and_again() -> Verdict {
    let daemon = world().daemon_with(COURIER)?;
    let network = RobotNetwork::with_discovery_server(&daemon.address)?;
    let site = network.robot()?;
    let stub = start_stub(&network, &site, "network-server")?;
    let mut application = network.start_application(RCLPY, &[])?;
    with_stub_log(&stub, || {
        ensure!(!sees_node(&mut application, NODE)?, "there is no server yet");
        let server = network.start_discovery_server()?;
        expect_correspondence(&mut application)?;
        // Participants that have discovered each other continue without the server; new ones are not discovered.
        server.kill()?;
        let told = application.send_order("send alone")?;
        ensure!(told == "by sea: alone", "{told}");
        let mut late = network.start_application(RCLPY, &["--ros-args", "-r", "__node:=late"])?;
        ensure!(!sees_node(&mut late, NODE)?, "the server has ended");
        let _server = network.start_discovery_server()?;
        expect_correspondence(&mut late)?;
        expect_original_names(&late.send_order("ends")?)?;
        let told = application.send_order("send again")?;
        ensure!(told == "by sea: again", "{told}");
        Ok(())
    })
}

pub fn another_machine_with_cyclone_dds_finds_a_stub() -> Verdict {
    let daemon = world().daemon_with(COURIER)?;
    let network = RobotNetwork::new(&daemon.address)?;
    let site = network.robot()?;
    let stub = start_stub(&network, &site, "network-cyclone")?;
    let mut application = network.start_application(CYCLONE, &[])?;
    with_stub_log(&stub, || expect_correspondence(&mut application))
}
