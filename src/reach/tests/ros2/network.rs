//! Real networks of a robot: other machines are namespaces connected by virtual cables.

use std::net::SocketAddr;
use std::os::fd::{AsFd, AsRawFd};
use std::process::Command;
use std::sync::Arc;
use std::time::{Duration, Instant};

use ros::bus::{Bus, BusError, QosProfile, Subscription, wait_for_connected};
use ros::ros2::Ros2Bus;
use ros::{DiscoveryNetwork, InterfaceSelection};
use serde_json::json as value;
use tokio::time::timeout;

use super::lab::{LONG, Lab, Peer, json, set_bool, set_bool_type, string, string_message, string_type, wait_graph};
use super::services::{CallerEchoService, request};

const NODE: &str = "/cloudroid_bridge";

/// Returns the network options of a stub on a robot.
pub fn robot_network() -> DiscoveryNetwork {
    DiscoveryNetwork { interfaces: InterfaceSelection::All, well_known: true, ..DiscoveryNetwork::default() }
}

fn ip(lab: &Lab, arguments: &str) {
    let mut command = Command::new("ip");
    command.args(arguments.split(' '));
    let done = lab.network.run(|| command.status());
    let done = done.expect("a namespace").expect("ip of iproute2");
    assert!(done.success(), "ip {arguments}");
}

/// Connects two machines with a cable: `10.NETWORK.0.1` here and `.2` there.
fn cable(here: &Lab, there: &Lab, network: u8) {
    let name = format!("cable{network}");
    let other = there.network.as_fd().as_raw_fd();
    let other = format!("/proc/{}/fd/{other}", std::process::id());
    ip(here, &format!("link add {name} type veth peer name {name} netns {other}"));
    for (lab, host) in [(here, 1), (there, 2)] {
        ip(lab, &format!("addr add 10.{network}.0.{host}/24 dev {name}"));
        ip(lab, &format!("link set {name} up"));
    }
    for lab in [here, there] {
        wait_carrier(lab, &name);
    }
}

/// Waits until the kernel reports a carrier, which takes up to a second: Fast DDS ignores interfaces without one, and
/// checks only once.
fn wait_carrier(lab: &Lab, name: &str) {
    let begun = Instant::now();
    let is_up = || {
        let mut command = Command::new("ip");
        command.args(["-brief", "link", "show", name]);
        let told = lab.network.run(|| command.output());
        let told = told.expect("a namespace").expect("ip of iproute2").stdout;
        let told = String::from_utf8(told).expect("text");
        told.split_whitespace().nth(1) == Some("UP")
    };
    while !is_up() {
        assert!(begun.elapsed() < LONG, "{name} does not carry");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// Creates a robot and another machine connected with a cable.
pub fn machines() -> (Lab, Lab) {
    let (robot, other) = (Lab::new(), Lab::new());
    cable(&robot, &other, 77);
    (robot, other)
}

/// Publishes on `/ping` and waits for the echo on `/pong`.
pub async fn converse(bus: &Ros2Bus) -> Subscription {
    let qos = QosProfile::keep_last(10);
    let mut pong = bus.subscribe("/pong", string_type(), qos).await.unwrap();
    let ping = bus.advertise("/ping", string_type(), qos).await.unwrap();
    for matched in [ping.matched_subscribers(), pong.matched.clone()] {
        timeout(LONG, wait_for_connected(matched, 1)).await.expect("somebody");
    }
    for number in 0..10 {
        ping.publish(string_message(&number.to_string()));
        let message = timeout(LONG, pong.messages.recv()).await;
        let message = message.expect("a message").expect("the bus is open");
        let expected = format!(r#"{{"data":"{number}"}}"#);
        assert_eq!(json(&string(), &message.bytes), expected);
    }
    pong
}

/// Calls the peer's service, and has it call ours.
pub async fn call_each_other(bus: &Ros2Bus, peer: &mut Peer, answer: &[serde_json::Value]) {
    wait_graph(bus, |graph| graph.services.contains_key("/set")).await;
    // Fast DDS drops a response if it does not know the reader for it within a moment, which a busy machine exceeds.
    let begun = Instant::now();
    let answered = loop {
        match bus.call("/set", request(true), LONG / 10).await {
            Err(BusError::Timeout { .. }) if begun.elapsed() < LONG => {}
            answered => break answered.unwrap(),
        }
    };
    let expected = r#"{"success":true,"message":"set"}"#;
    assert_eq!(json(&set_bool().response, &answered), expected);
    let served = bus.serve("/ask", set_bool_type(), Arc::new(CallerEchoService)).await;
    let _served = served.unwrap();
    let told = peer.obey("call true").await;
    assert_eq!(told[..answer.len()], *answer);
}

/// Kills the peer and returns the time until that is detected.
pub async fn measure_loss_detection(peer: &mut Peer, pong: Subscription) -> Duration {
    let mut matched = pong.matched.clone();
    let begun = Instant::now();
    peer.kill();
    let gone = timeout(LONG, matched.wait_for(|matched| matched.peers.is_empty())).await;
    gone.expect("in time").expect("the bus is open");
    begun.elapsed()
}

#[tokio::test]
async fn a_node_of_rclpy_on_another_machine() {
    let (robot, other) = machines();
    let mut peer = other.peer().await;
    let bus = robot.join_network(NODE, robot_network()).await;
    let pong = converse(&bus).await;
    call_each_other(&bus, &mut peer, &[value!(true), value!("/lab/peer")]).await;
    // By its lease of 20 s; its last assertion may be some seconds old.
    let noticed = measure_loss_detection(&mut peer, pong).await;
    assert!(noticed < Duration::from_secs(25), "{noticed:?}");
    wait_graph(&bus, |graph| !graph.nodes.contains_key("/lab/peer")).await;
}

#[tokio::test]
async fn a_participant_of_cyclone_on_another_machine() {
    let (robot, other) = machines();
    let mut peer = other.node("cyclone.py", &[]).await;
    let bus = robot.join_network(NODE, robot_network()).await;
    let pong = converse(&bus).await;
    call_each_other(&bus, &mut peer, &[value!(0), value!(true)]).await;
    // By its lease of 10 s.
    let noticed = measure_loss_detection(&mut peer, pong).await;
    assert!(noticed < Duration::from_secs(15), "{noticed:?}");
}

#[tokio::test]
async fn a_node_on_the_robot_itself_is_seen_to_be_killed() {
    let (robot, _other) = machines();
    let mut peer = robot.peer().await;
    let bus = robot.join_network(NODE, robot_network()).await;
    let pong = converse(&bus).await;
    call_each_other(&bus, &mut peer, &[value!(true), value!("/lab/peer")]).await;
    // Its ports are checked five times a second.
    let noticed = measure_loss_detection(&mut peer, pong).await;
    assert!(noticed < Duration::from_secs(2), "{noticed:?}");
}

#[tokio::test]
async fn nodes_in_two_networks_are_heard() {
    let (robot, left, right) = (Lab::new(), Lab::new(), Lab::new());
    cable(&robot, &left, 77);
    cable(&robot, &right, 78);
    let (_one, _two) = tokio::join!(left.peer(), right.node("cyclone.py", &[]));
    let bus = robot.join_network(NODE, robot_network()).await;
    let ping = bus.advertise("/ping", string_type(), QosProfile::keep_last(10)).await.unwrap();
    let both = timeout(LONG, wait_for_connected(ping.matched_subscribers(), 2)).await;
    both.expect("one in each network");
}

#[tokio::test]
async fn a_network_that_comes_later_is_used() {
    let (robot, other) = (Lab::new(), Lab::new());
    let bus = robot.join_network(NODE, robot_network()).await;
    let before = robot.peer().await;
    converse(&bus).await;
    drop(before);
    // Wi-Fi comes up.
    cable(&robot, &other, 77);
    let _peer = other.node("cyclone.py", &[]).await;
    converse(&bus).await;
}

#[tokio::test]
async fn peers_are_told_where_there_is_no_multicast() {
    let (robot, other) = machines();
    let narrow = [("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")];
    let mut peer = other.node_with("peer.py", &[], &narrow).await;
    let network =
        DiscoveryNetwork { multicast: false, peers: vec![SocketAddr::from(([10, 77, 0, 2], 0))], ..robot_network() };
    let bus = robot.join_network(NODE, network).await;
    converse(&bus).await;
    call_each_other(&bus, &mut peer, &[value!(true), value!("/lab/peer")]).await;
}

#[tokio::test]
async fn whoever_is_to_be_alone_is() {
    let robot = Lab::new();
    let mut peer = robot.peer().await;
    let network = DiscoveryNetwork { alone: true, ..DiscoveryNetwork::default() };
    let alone = robot.join_network(NODE, network).await;
    // The peer discovers newcomers, so it would have discovered this one.
    let bus = robot.join("/seen").await;
    converse(&bus).await;
    assert!(alone.graph().borrow().nodes.keys().all(|node| node == NODE));
    let told = peer.obey("publishers_of /ping").await;
    assert!(!value!(told).to_string().contains(NODE));
}
