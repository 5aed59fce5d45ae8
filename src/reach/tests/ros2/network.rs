//! A robot's real networks: other machines are namespaces at the other ends of virtual cables.

use std::net::SocketAddr;
use std::os::fd::{AsFd, AsRawFd};
use std::process::Command;
use std::sync::Arc;
use std::time::{Duration, Instant};

use ros::bus::{Bus, Qos, Subscription, reaches};
use ros::ros2::Ros2Bus;
use ros::{Interfaces, Network};
use serde_json::json as value;
use tokio::time::timeout;

use super::lab::{LONG, Lab, Peer, json, of_set_bool, of_string, said, set_bool, shows, string};
use super::services::{Answers, request};

const NODE: &str = "/cloudroid_bridge";

/// As a stub on a robot has it.
pub fn robots() -> Network {
    Network {
        interfaces: Interfaces::All,
        well_known: true,
        ..Network::default()
    }
}

fn ip(lab: &Lab, arguments: &str) {
    let mut command = Command::new("ip");
    command.args(arguments.split(' '));
    let done = lab.network.run(|| command.status());
    let done = done.expect("a namespace").expect("ip of iproute2");
    assert!(done.success(), "ip {arguments}");
}

/// A cable between two machines: `10.NETWORK.0.1` here and `.2` there.
fn cable(here: &Lab, there: &Lab, network: u8) {
    let name = format!("cable{network}");
    let other = there.network.as_fd().as_raw_fd();
    let other = format!("/proc/{}/fd/{other}", std::process::id());
    ip(
        here,
        &format!("link add {name} type veth peer name {name} netns {other}"),
    );
    for (lab, host) in [(here, 1), (there, 2)] {
        ip(
            lab,
            &format!("addr add 10.{network}.0.{host}/24 dev {name}"),
        );
        ip(lab, &format!("link set {name} up"));
    }
    for lab in [here, there] {
        carries(lab, &name);
    }
}

/// Waits until the kernel says that a cable carries, up to a second later: Fast DDS uses no interface for which it does not, and
/// looks once.
fn carries(lab: &Lab, name: &str) {
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

/// A robot and another machine with a cable between them.
pub fn machines() -> (Lab, Lab) {
    let (robot, other) = (Lab::new(), Lab::new());
    cable(&robot, &other, 77);
    (robot, other)
}

/// Says things on `/ping`, and hears each on `/pong`.
pub async fn converse(bus: &Ros2Bus) -> Subscription {
    let qos = Qos::keep_last(10);
    let mut pong = bus.subscribe("/pong", of_string(), qos).await.unwrap();
    let ping = bus.advertise("/ping", of_string(), qos).await.unwrap();
    for matched in [ping.matched(), pong.matched.clone()] {
        timeout(LONG, reaches(matched, 1)).await.expect("somebody");
    }
    for number in 0..10 {
        ping.publish(said(&number.to_string()));
        let message = timeout(LONG, pong.messages.recv()).await;
        let message = message.expect("a message").expect("the bus is open");
        let expected = format!(r#"{{"data":"{number}"}}"#);
        assert_eq!(json(&string(), &message.bytes), expected);
    }
    pong
}

/// Calls its service, and has it call ours.
pub async fn call_each_other(bus: &Ros2Bus, peer: &mut Peer, answer: &[serde_json::Value]) {
    shows(bus, |graph| graph.services.contains_key("/set")).await;
    let answered = bus.call("/set", request(true), LONG).await.unwrap();
    let expected = r#"{"success":true,"message":"set"}"#;
    assert_eq!(json(&set_bool().response, &answered), expected);
    let served = bus.serve("/ask", of_set_bool(), Arc::new(Answers)).await;
    let _served = served.unwrap();
    let told = peer.obey("call true").await;
    assert_eq!(told[..answer.len()], *answer);
}

/// How long it takes until its being killed is noticed.
pub async fn killed(peer: &mut Peer, pong: Subscription) -> Duration {
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
    let bus = robot.join_network(NODE, robots()).await;
    let pong = converse(&bus).await;
    call_each_other(&bus, &mut peer, &[value!(true), value!("/lab/peer")]).await;
    // By its lease: 20 s, and its last word may be some seconds old.
    let noticed = killed(&mut peer, pong).await;
    assert!(noticed < Duration::from_secs(25), "{noticed:?}");
    shows(&bus, |graph| !graph.nodes.contains_key("/lab/peer")).await;
}

#[tokio::test]
async fn a_participant_of_cyclone_on_another_machine() {
    let (robot, other) = machines();
    let mut peer = other.node("cyclone.py", &[]).await;
    let bus = robot.join_network(NODE, robots()).await;
    let pong = converse(&bus).await;
    call_each_other(&bus, &mut peer, &[value!(0), value!(true)]).await;
    // By its lease of 10 s.
    let noticed = killed(&mut peer, pong).await;
    assert!(noticed < Duration::from_secs(15), "{noticed:?}");
}

#[tokio::test]
async fn a_node_on_the_robot_itself_is_seen_to_be_killed() {
    let (robot, _other) = machines();
    let mut peer = robot.peer().await;
    let bus = robot.join_network(NODE, robots()).await;
    let pong = converse(&bus).await;
    call_each_other(&bus, &mut peer, &[value!(true), value!("/lab/peer")]).await;
    // Its ports are looked at five times a second.
    let noticed = killed(&mut peer, pong).await;
    assert!(noticed < Duration::from_secs(2), "{noticed:?}");
}

#[tokio::test]
async fn nodes_in_two_networks_are_heard() {
    let (robot, left, right) = (Lab::new(), Lab::new(), Lab::new());
    cable(&robot, &left, 77);
    cable(&robot, &right, 78);
    let (_one, _two) = tokio::join!(left.peer(), right.node("cyclone.py", &[]));
    let bus = robot.join_network(NODE, robots()).await;
    let ping = bus
        .advertise("/ping", of_string(), Qos::keep_last(10))
        .await
        .unwrap();
    let both = timeout(LONG, reaches(ping.matched(), 2)).await;
    both.expect("one in each network");
}

#[tokio::test]
async fn a_network_that_comes_later_is_used() {
    let (robot, other) = (Lab::new(), Lab::new());
    let bus = robot.join_network(NODE, robots()).await;
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
    let network = Network {
        multicast: false,
        peers: vec![SocketAddr::from(([10, 77, 0, 2], 0))],
        ..robots()
    };
    let bus = robot.join_network(NODE, network).await;
    converse(&bus).await;
    call_each_other(&bus, &mut peer, &[value!(true), value!("/lab/peer")]).await;
}

#[tokio::test]
async fn whoever_is_to_be_alone_is() {
    let robot = Lab::new();
    let mut peer = robot.peer().await;
    let network = Network {
        alone: true,
        ..Network::default()
    };
    let alone = robot.join_network(NODE, network).await;
    // Who comes after it is found by the peer, and so it would have been.
    let bus = robot.join("/seen").await;
    converse(&bus).await;
    assert!(alone.graph().borrow().nodes.keys().all(|node| node == NODE));
    let told = peer.obey("publishers_of /ping").await;
    assert!(!value!(told).to_string().contains(NODE));
}
