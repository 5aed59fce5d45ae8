//! Robots whose nodes use a Fast DDS discovery server instead of multicast: server and nodes are those of rclpy.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use ros::bus::{Bus, QosProfile, wait_for_connected};
use ros::ros2::Ros2Bus;
use ros::{DiscoveryNetwork, DiscoveryServer, InterfaceSelection};
use serde_json::json as value;
use tokio::time::timeout;

use super::lab::{LONG, Lab, Peer, json, string, string_message, string_type, wait_graph};
use super::network::{call_each_other, converse, machines, measure_loss_detection};

const NODE: &str = "/cloudroid_bridge";
const PEER: &str = "/lab/peer";
const TUNED: &str = "/lab/tuned";

/// A server with a position in the list of servers.
struct LocalDiscoveryServer {
    place: u8,
    at: Ipv4Addr,
}

impl LocalDiscoveryServer {
    fn new(place: u8, at: Ipv4Addr) -> Self {
        Self { place, at }
    }

    fn local(place: u8) -> Self {
        Self::new(place, Ipv4Addr::LOCALHOST)
    }

    fn address(&self) -> SocketAddr {
        SocketAddr::from((self.at, 11811 + u16::from(self.place)))
    }

    async fn start(&self, lab: &Lab) -> Peer {
        let arguments = [self.place.to_string(), self.at.to_string()];
        lab.node("server.py", &arguments.each_ref().map(String::as_str)).await
    }
}

/// Returns the environment for nodes and the options for a stub that use these servers.
fn server_environment(servers: &[&LocalDiscoveryServer]) -> (String, DiscoveryNetwork) {
    let addresses = servers.iter().map(|server| server.address().to_string());
    let network = DiscoveryNetwork {
        multicast: false,
        servers: servers.iter().map(|server| DiscoveryServer { place: server.place, at: server.address() }).collect(),
        well_known: true,
        ..DiscoveryNetwork::default()
    };
    (addresses.collect::<Vec<_>>().join(";"), network)
}

/// Starts a node that uses only these servers.
async fn node(lab: &Lab, program: &str, servers: &[&LocalDiscoveryServer]) -> Peer {
    let (list, _) = server_environment(servers);
    let environment = [("ROS_DISCOVERY_SERVER", list.as_str())];
    lab.node_with(program, &[], &environment).await
}

async fn join(lab: &Lab, servers: &[&LocalDiscoveryServer]) -> Arc<Ros2Bus> {
    lab.join_network(NODE, server_environment(servers).1).await
}

fn knows(bus: &Ros2Bus, node: &str) -> bool {
    bus.graph().borrow().nodes.contains_key(node)
}

#[tokio::test]
async fn nodes_and_we_find_each_other_by_a_server_alone() {
    let lab = Lab::new();
    let server = LocalDiscoveryServer::local(0);
    let _running = server.start(&lab).await;
    let mut peer = node(&lab, "peer.py", &[&server]).await;
    // This node does not use the server, and would be found by multicast.
    let _other = lab.node("tuned.py", &[]).await;
    let by_multicast = lab.join("/seen").await;
    wait_graph(&by_multicast, |graph| graph.nodes.contains_key(TUNED)).await;
    let bus = join(&lab, &[&server]).await;
    converse(&bus).await;
    call_each_other(&bus, &mut peer, &[value!(true), value!(PEER)]).await;
    assert!(knows(&bus, PEER) && !knows(&bus, TUNED) && !knows(&bus, "/seen"));
    assert!(!knows(&by_multicast, PEER) && !knows(&by_multicast, NODE));
}

#[tokio::test]
async fn a_server_comes_later_and_ends_and_comes_again() {
    let lab = Lab::new();
    let server = LocalDiscoveryServer::local(0);
    let bus = join(&lab, &[&server]).await;
    let _peer = node(&lab, "peer.py", &[&server]).await;
    assert!(!knows(&bus, PEER));
    let mut running = server.start(&lab).await;
    wait_graph(&bus, |graph| graph.nodes.contains_key(PEER)).await;
    let qos = QosProfile::keep_last(10);
    let mut pong = bus.subscribe("/pong", string_type(), qos).await.unwrap();
    let ping = bus.advertise("/ping", string_type(), qos).await.unwrap();
    for matched in [ping.matched_subscribers(), pong.matched.clone()] {
        timeout(LONG, wait_for_connected(matched, 1)).await.expect("somebody");
    }
    running.kill_and_wait().await;
    // Existing matches remain; no new participants are found.
    let _late = node(&lab, "tuned.py", &[&server]).await;
    ping.publish(string_message("without a server"));
    let message = timeout(LONG, pong.messages.recv()).await;
    let message = message.expect("a message").expect("the bus is open");
    let expected = r#"{"data":"without a server"}"#;
    assert_eq!(json(&string(), &message.bytes), expected);
    assert!(!knows(&bus, TUNED));
    let _again = server.start(&lab).await;
    wait_graph(&bus, |graph| graph.nodes.contains_key(TUNED)).await;
    // It knows us again as well: newcomers find us.
    drop((ping, pong));
    converse(&bus).await;
}

#[tokio::test]
async fn of_several_servers_each_suffices() {
    let lab = Lab::new();
    let servers = [LocalDiscoveryServer::local(0), LocalDiscoveryServer::local(1)];
    let both = [&servers[0], &servers[1]];
    let mut second = servers[1].start(&lab).await;
    let bus = join(&lab, &both).await;
    let mut peer = node(&lab, "peer.py", &both).await;
    converse(&bus).await;
    let _first = servers[0].start(&lab).await;
    second.kill_and_wait().await;
    let _late = node(&lab, "tuned.py", &both).await;
    wait_graph(&bus, |graph| graph.nodes.contains_key(TUNED)).await;
    call_each_other(&bus, &mut peer, &[value!(true), value!(PEER)]).await;
}

#[tokio::test]
async fn a_server_and_a_node_on_another_machine() {
    let (robot, other) = machines();
    let server = LocalDiscoveryServer::new(0, Ipv4Addr::new(10, 77, 0, 2));
    let _running = server.start(&other).await;
    let mut peer = node(&other, "peer.py", &[&server]).await;
    let network = DiscoveryNetwork { interfaces: InterfaceSelection::All, ..server_environment(&[&server]).1 };
    let bus = robot.join_network(NODE, network).await;
    let pong = converse(&bus).await;
    call_each_other(&bus, &mut peer, &[value!(true), value!(PEER)]).await;
    // The server reports it when the node's lease of 20 s has expired.
    let noticed = measure_loss_detection(&mut peer, pong).await;
    assert!(noticed < Duration::from_secs(30), "{noticed:?}");
    wait_graph(&bus, |graph| !graph.nodes.contains_key(PEER)).await;
}
