//! Tests with two buses of one process, which meet on this machine's loopback interface.

mod graph;
mod hostile;
mod services;
mod topics;

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use ros_bus::{Bus, MatchedPeers, RosVersion, SerializedMessage, Subscription, WireType, wait_for_connected};
use ros_message::schema::MessageType;
use tokio::sync::watch;
use tokio::time::timeout;

use super::testing::{domain, join};

/// Longer than anything here takes.
const LONG: Duration = Duration::from_secs(60);

/// Creates a message type with this definition.
fn message_type(name: &str, text: &str) -> Arc<MessageType> {
    MessageType::parse_full_text(RosVersion::Two, name, text).expect("a definition")
}

fn string() -> WireType {
    WireType::from_message(&message_type("std_msgs/msg/String", "string data"))
}

/// Creates a serialized message identified by this number. Its size is a multiple of 4; other sizes are padded in
/// transit.
fn numbered_message(number: u8) -> Bytes {
    Bytes::copy_from_slice(&[0, 1, 0, 0, 4, 0, 0, 0, number, b'.', b'.', 0])
}

async fn next(subscription: &mut Subscription) -> SerializedMessage {
    let message = timeout(LONG, subscription.messages.recv()).await;
    message.expect("a message should come").expect("the bus is open")
}

/// Returns the numbers of the next messages.
async fn numbers(subscription: &mut Subscription, count: usize) -> Vec<u8> {
    let mut numbers = Vec::new();
    while numbers.len() < count {
        numbers.push(next(subscription).await.bytes[8]);
    }
    numbers
}

async fn expect_connected(matched: watch::Receiver<MatchedPeers>, count: usize) {
    let reached = timeout(LONG, wait_for_connected(matched, count)).await;
    reached.unwrap_or_else(|_| panic!("{count} should be connected"));
}

async fn wait_for_matched(
    mut matched: watch::Receiver<MatchedPeers>,
    wanted: impl Fn(&MatchedPeers) -> bool,
) -> MatchedPeers {
    let found = timeout(LONG, matched.wait_for(|matched| wanted(matched))).await;
    found.expect("in time").expect("the bus is open").clone()
}
