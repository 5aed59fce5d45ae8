//! Robots whose nodes find each other by a discovery server of Fast DDS, and not by multicast: server and nodes are rclpy's.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use ros::bus::{Bus, Qos, reaches};
use ros::ros2::Ros2Bus;
use ros::{DiscoveryServer, Interfaces, Network};
use serde_json::json as value;
use tokio::time::timeout;

use super::lab::{LONG, Lab, Peer, json, of_string, said, shows, string};
use super::network::{call_each_other, converse, killed, machines};

const NODE: &str = "/cloudroid_bridge";
const PEER: &str = "/lab/peer";
const TUNED: &str = "/lab/tuned";

/// A server at a place of the list of servers.
struct Server {
    place: u8,
    at: Ipv4Addr,
}

impl Server {
    fn of(place: u8, at: Ipv4Addr) -> Self {
        Self { place, at }
    }

    fn here(place: u8) -> Self {
        Self::of(place, Ipv4Addr::LOCALHOST)
    }

    fn address(&self) -> SocketAddr {
        SocketAddr::from((self.at, 11811 + u16::from(self.place)))
    }

    async fn starts(&self, lab: &Lab) -> Peer {
        let arguments = [self.place.to_string(), self.at.to_string()];
        lab.node("server.py", &arguments.each_ref().map(String::as_str))
            .await
    }
}

/// As nodes are told of them, and a stub.
fn named(servers: &[&Server]) -> (String, Network) {
    let addresses = servers.iter().map(|server| server.address().to_string());
    let network = Network {
        multicast: false,
        servers: servers
            .iter()
            .map(|server| DiscoveryServer {
                place: server.place,
                at: server.address(),
            })
            .collect(),
        well_known: true,
        ..Network::default()
    };
    (addresses.collect::<Vec<_>>().join(";"), network)
}

/// A node that looks for others by these servers alone.
async fn node(lab: &Lab, program: &str, servers: &[&Server]) -> Peer {
    let (list, _) = named(servers);
    let environment = [("ROS_DISCOVERY_SERVER", list.as_str())];
    lab.node_with(program, &[], &environment).await
}

async fn join(lab: &Lab, servers: &[&Server]) -> Arc<Ros2Bus> {
    lab.join_network(NODE, named(servers).1).await
}

fn knows(bus: &Ros2Bus, node: &str) -> bool {
    bus.graph().borrow().nodes.contains_key(node)
}

#[tokio::test]
async fn nodes_and_we_find_each_other_by_a_server_alone() {
    let lab = Lab::new();
    let server = Server::here(0);
    let _running = server.starts(&lab).await;
    let mut peer = node(&lab, "peer.py", &[&server]).await;
    // This node does not know of the server, and whoever looks for it by multicast finds it.
    let _other = lab.node("tuned.py", &[]).await;
    let by_multicast = lab.join("/seen").await;
    shows(&by_multicast, |graph| graph.nodes.contains_key(TUNED)).await;
    let bus = join(&lab, &[&server]).await;
    converse(&bus).await;
    call_each_other(&bus, &mut peer, &[value!(true), value!(PEER)]).await;
    assert!(knows(&bus, PEER) && !knows(&bus, TUNED) && !knows(&bus, "/seen"));
    assert!(!knows(&by_multicast, PEER) && !knows(&by_multicast, NODE));
}

#[tokio::test]
async fn a_server_comes_later_and_ends_and_comes_again() {
    let lab = Lab::new();
    let server = Server::here(0);
    let bus = join(&lab, &[&server]).await;
    let _peer = node(&lab, "peer.py", &[&server]).await;
    assert!(!knows(&bus, PEER));
    let mut running = server.starts(&lab).await;
    shows(&bus, |graph| graph.nodes.contains_key(PEER)).await;
    let qos = Qos::keep_last(10);
    let mut pong = bus.subscribe("/pong", of_string(), qos).await.unwrap();
    let ping = bus.advertise("/ping", of_string(), qos).await.unwrap();
    for matched in [ping.matched(), pong.matched.clone()] {
        timeout(LONG, reaches(matched, 1)).await.expect("somebody");
    }
    running.ends().await;
    // Whoever has found each other goes on; nobody else is found.
    let _late = node(&lab, "tuned.py", &[&server]).await;
    ping.publish(said("without a server"));
    let message = timeout(LONG, pong.messages.recv()).await;
    let message = message.expect("a message").expect("the bus is open");
    let expected = r#"{"data":"without a server"}"#;
    assert_eq!(json(&string(), &message.bytes), expected);
    assert!(!knows(&bus, TUNED));
    let _again = server.starts(&lab).await;
    shows(&bus, |graph| graph.nodes.contains_key(TUNED)).await;
    // It knows us again, too: whoever comes now finds us.
    drop((ping, pong));
    converse(&bus).await;
}

#[tokio::test]
async fn of_several_servers_each_suffices() {
    let lab = Lab::new();
    let servers = [Server::here(0), Server::here(1)];
    let both = [&servers[0], &servers[1]];
    let mut second = servers[1].starts(&lab).await;
    let bus = join(&lab, &both).await;
    let mut peer = node(&lab, "peer.py", &both).await;
    converse(&bus).await;
    let _first = servers[0].starts(&lab).await;
    second.ends().await;
    let _late = node(&lab, "tuned.py", &both).await;
    shows(&bus, |graph| graph.nodes.contains_key(TUNED)).await;
    call_each_other(&bus, &mut peer, &[value!(true), value!(PEER)]).await;
}

#[tokio::test]
async fn a_server_and_a_node_on_another_machine() {
    let (robot, other) = machines();
    let server = Server::of(0, Ipv4Addr::new(10, 77, 0, 2));
    let _running = server.starts(&other).await;
    let mut peer = node(&other, "peer.py", &[&server]).await;
    let network = Network {
        interfaces: Interfaces::All,
        ..named(&[&server]).1
    };
    let bus = robot.join_network(NODE, network).await;
    let pong = converse(&bus).await;
    call_each_other(&bus, &mut peer, &[value!(true), value!(PEER)]).await;
    // The server says so, when the node's lease of 20 s is over.
    let noticed = killed(&mut peer, pong).await;
    assert!(noticed < Duration::from_secs(30), "{noticed:?}");
    shows(&bus, |graph| !graph.nodes.contains_key(PEER)).await;
}
