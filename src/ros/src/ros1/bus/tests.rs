//! Two buses, or a bus and something made by hand, at a Master of their own.

mod actions;
mod hostile;
mod lending;
mod master_client;
mod services;
mod topics;

use super::*;
use crate::bus::{Message, MessageReceiver, PeerId};
use crate::net::HostSockets;
use crate::ros1::testing::{LONG, TestMaster};

pub(super) async fn join(master: &TestMaster, name: &str) -> Arc<Ros1Bus> {
    let sockets = Arc::new(HostSockets);
    Ros1Bus::connect(sockets, master.address, name)
        .await
        .unwrap()
}

pub(super) fn text_type(md5: &str) -> WireType {
    WireType::new("std_msgs/String", md5, "string data\n")
}

pub(super) async fn says(bus: &Ros1Bus, topic: &str, latch: bool) -> Box<dyn Publisher> {
    let qos = Qos::keep_last(100).latching(latch);
    bus.advertise(topic, text_type("992c"), qos).await.unwrap()
}

pub(super) async fn hears(bus: &Ros1Bus, topic: &str) -> Subscription {
    let qos = Qos::keep_last(100);
    bus.subscribe(topic, WireType::any(), qos).await.unwrap()
}

/// Waits until `count` subscribers are connected.
pub(super) async fn connected(publisher: &dyn Publisher, count: usize) {
    let mut now = publisher.matched();
    let reached = tokio::time::timeout(LONG, now.wait_for(|now| now.connected() == count));
    reached.await.expect("subscribers should connect").unwrap();
}

/// The next message; a test does not wait for ever.
pub(super) async fn next(messages: &mut MessageReceiver) -> Message {
    let message = tokio::time::timeout(LONG, messages.recv()).await;
    message
        .expect("a message should come")
        .expect("not the end")
}

pub(super) async fn next_text(messages: &mut MessageReceiver) -> String {
    String::from_utf8(next(messages).await.bytes.to_vec()).unwrap()
}

/// Waits until the bus's graph is as wanted.
pub(super) async fn until(bus: &Ros1Bus, wanted: impl Fn(&Graph) -> bool) {
    let mut graph = bus.graph();
    let found = tokio::time::timeout(LONG, graph.wait_for(|graph| wanted(graph)));
    let found = found.await.is_ok();
    assert!(found, "{:#?}", bus.graph().borrow());
}
