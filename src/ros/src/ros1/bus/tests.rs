//! Two buses, or a bus and something made by hand, at a Master of their own.

mod hostile;
mod lending;
mod services;
mod topics;

use super::*;
use crate::bus::{Message, MessageReceiver};
use crate::net::HostSockets;
use crate::ros1::testing::{LONG, TestMaster};

pub(super) async fn join(master: &TestMaster, name: &str) -> Arc<Ros1Bus> {
    let sockets = Arc::new(HostSockets);
    Ros1Bus::connect(sockets, master.address, name)
        .await
        .unwrap()
}

pub(super) fn text_type(md5: &str) -> WireType {
    WireType {
        name: "std_msgs/String".to_owned(),
        md5: md5.to_owned(),
        definition: "string data\n".to_owned(),
    }
}

pub(super) fn publishing(latch: bool) -> AdvertiseOptions {
    AdvertiseOptions {
        wire_type: text_type("992c"),
        latch,
        queue: 100,
    }
}

pub(super) fn any() -> SubscribeOptions {
    SubscribeOptions {
        wire_type: None,
        queue: 100,
    }
}

/// Waits until `count` subscribers are connected.
pub(super) async fn connected(publisher: &dyn Publisher, count: usize) {
    let mut now = publisher.subscribers();
    let reached = tokio::time::timeout(LONG, now.wait_for(|now| *now == count));
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
