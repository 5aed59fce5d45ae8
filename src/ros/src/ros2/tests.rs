//! Two buses of one process, which meet on the loopback of this machine.

mod graph;
mod hostile;
mod services;
mod topics;

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use tokio::sync::watch;
use tokio::time::timeout;

use super::testing::{domain, join};
use crate::bus::{Bus, Matched, Message, RosVersion, Subscription, WireType, reaches};
use crate::schema::MessageType;

/// Longer than anything here takes.
const LONG: Duration = Duration::from_secs(60);

/// A message type of this text.
fn message_type(name: &str, text: &str) -> Arc<MessageType> {
    MessageType::of_full_text(RosVersion::Two, name, text).expect("a definition")
}

fn string() -> WireType {
    WireType::of(&message_type("std_msgs/msg/String", "string data"))
}

/// A serialized message, told from others by this number. Its size is a multiple of 4: others are filled up on their way.
fn numbered(number: u8) -> Bytes {
    Bytes::copy_from_slice(&[0, 1, 0, 0, 4, 0, 0, 0, number, b'.', b'.', 0])
}

async fn next(subscription: &mut Subscription) -> Message {
    let message = timeout(LONG, subscription.messages.recv()).await;
    message
        .expect("a message should come")
        .expect("the bus is open")
}

/// The next numbers that come.
async fn numbers(subscription: &mut Subscription, count: usize) -> Vec<u8> {
    let mut numbers = Vec::new();
    while numbers.len() < count {
        numbers.push(next(subscription).await.bytes[8]);
    }
    numbers
}

async fn connected(matched: watch::Receiver<Matched>, count: usize) {
    let reached = timeout(LONG, reaches(matched, count)).await;
    reached.unwrap_or_else(|_| panic!("{count} should be connected"));
}

async fn until(
    mut matched: watch::Receiver<Matched>,
    wanted: impl Fn(&Matched) -> bool,
) -> Matched {
    let found = timeout(LONG, matched.wait_for(|matched| wanted(matched))).await;
    found.expect("in time").expect("the bus is open").clone()
}
