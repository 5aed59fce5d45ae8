//! Tests with two buses, or a bus and a hand-made peer, at a Master of their own.

mod actions;
mod hostile;
mod lending;
mod master_client;
mod services;
mod topics;

use ros_bus::net::HostSockets;
use ros_bus::{MessageReceiver, PeerId, SerializedMessage};

use super::*;
use crate::testing::{PATIENCE, TestMaster};

pub(super) async fn join(master: &TestMaster, name: &str) -> Arc<Ros1Bus> {
    let sockets = Arc::new(HostSockets);
    Ros1Bus::connect(sockets, master.address, name).await.unwrap()
}

pub(super) fn text_type(md5: &str) -> WireType {
    WireType::new("std_msgs/String", md5, "string data\n")
}

pub(super) async fn advertise_text(bus: &Ros1Bus, topic: &str, latch: bool) -> Box<dyn Publisher> {
    let qos = QosProfile::keep_last(100).latching(latch);
    bus.advertise(topic, text_type("992c"), qos).await.unwrap()
}

pub(super) async fn subscribe_text(bus: &Ros1Bus, topic: &str) -> Subscription {
    let qos = QosProfile::keep_last(100);
    bus.subscribe(topic, WireType::any(), qos).await.unwrap()
}

/// Waits until `count` subscribers are connected.
pub(super) async fn wait_for_subscribers(publisher: &dyn Publisher, count: usize) {
    let mut now = publisher.matched_subscribers();
    let reached = tokio::time::timeout(PATIENCE, now.wait_for(|now| now.connected_count() == count));
    reached.await.expect("subscribers should connect").unwrap();
}

/// Returns the next message, with a time limit.
pub(super) async fn next(messages: &mut MessageReceiver) -> SerializedMessage {
    let message = tokio::time::timeout(PATIENCE, messages.recv()).await;
    message.expect("a message should come").expect("not the end")
}

pub(super) async fn next_text(messages: &mut MessageReceiver) -> String {
    String::from_utf8(next(messages).await.bytes.to_vec()).unwrap()
}

/// Waits until the bus's graph satisfies `wanted`.
pub(super) async fn wait_for_graph(bus: &Ros1Bus, wanted: impl Fn(&Graph) -> bool) {
    let mut graph = bus.graph();
    let found = tokio::time::timeout(PATIENCE, graph.wait_for(|graph| wanted(graph)));
    let found = found.await.is_ok();
    assert!(found, "{:#?}", bus.graph().borrow());
}
