//! Keeps the latched messages of the robot's publishers for the local original. Each publisher gets an advertisement of
//! its own in the private ROS system, so that a process that starts later receives all of them.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;

use parking_lot::Mutex;
use ros::bus::{Digest, PeerId, Publisher, QosProfile, RosVersion, SerializedMessage, WireType};
use ros::ring::{Ring, RingBounds};
use tokio::sync::Notify;
use tokio::task::AbortHandle;

use super::private_system::PrivateSystem;

/// Queue length of one publisher, for a slow process and while its advertisement is made; a new process gets the last
/// message of each publisher.
const QUEUE: usize = 16;

/// Handle of the relay; the advertisements end with it.
pub struct LatchedRelay {
    due: Arc<PendingLatched>,
    task: AbortHandle,
}

/// A topic and one of its publishers.
type PublisherKey = (Arc<str>, PeerId);

/// Messages that are not relayed yet, by publisher, in the order in which publishers were first seen.
#[derive(Default)]
struct PendingLatched {
    state: Mutex<(HashMap<PublisherKey, LatchedUpdate>, VecDeque<PublisherKey>)>,
    ready: Notify,
}

/// Pending updates of one publisher.
struct LatchedUpdate {
    /// Set if the publisher has left: messages that it latched before are void.
    left: bool,
    messages: Ring<SerializedMessage>,
}

impl PendingLatched {
    fn add(&self, topic: &Arc<str>, publisher: &PeerId, news: impl FnOnce(&mut LatchedUpdate)) {
        {
            let (known, turns) = &mut *self.state.lock();
            let key = (topic.clone(), publisher.clone());
            let of = known.entry(key.clone()).or_insert_with(|| {
                turns.push_back(key);
                LatchedUpdate { left: false, messages: Ring::new(RingBounds::with_messages(QUEUE)) }
            });
            news(of);
        }
        self.ready.notify_one();
    }

    async fn next_update(&self) -> (PublisherKey, LatchedUpdate) {
        loop {
            {
                let (known, turns) = &mut *self.state.lock();
                if let Some(entry) = turns.pop_front().and_then(|key| known.remove_entry(&key)) {
                    return entry;
                }
            }
            self.ready.notified().await;
        }
    }
}

impl Drop for LatchedRelay {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl LatchedRelay {
    pub fn start(system: &Arc<PrivateSystem>) -> Self {
        let due = Arc::new(PendingLatched::default());
        let task = tokio::spawn(serve(system.clone(), due.clone())).abort_handle();
        Self { due, task }
    }

    /// Adds a message of a publisher that latches.
    pub fn push(&self, topic: &Arc<str>, message: &SerializedMessage) {
        self.due.add(topic, &message.publisher, |news| {
            let lost = news.messages.push(message.clone());
            if lost.messages > 0 {
                tracing::debug!(%topic, dropped = lost.messages, "newer latched messages replaced older ones");
            }
        });
    }

    /// Handles the end of a publisher.
    pub fn remove_publisher(&self, topic: &Arc<str>, publisher: &PeerId) {
        self.due.add(topic, publisher, |news| {
            news.left = true;
            news.messages.clear();
        });
    }
}

/// Type digest and advertisement of each publisher.
type RelayedPublishers = HashMap<PublisherKey, (Digest, Box<dyn Publisher>)>;

/// Relays one publisher after the other; only the first message of each takes time, for the advertisement.
async fn serve(system: Arc<PrivateSystem>, due: Arc<PendingLatched>) {
    let mut all = RelayedPublishers::new();
    loop {
        let (key, news) = due.next_update().await;
        if news.left {
            all.remove(&key);
        }
        for message in news.messages {
            let digest = &message.wire_type.digest;
            if let Some((_, publisher)) = all.get(&key).filter(|(known, _)| known == digest) {
                publisher.publish(message.bytes);
                continue;
            }
            let of = WireType::clone(&message.wire_type);
            let depth = match system.bus().version() {
                RosVersion::One => QUEUE,
                // In ROS 2 a publisher sends new subscribers everything that it keeps.
                RosVersion::Two => 1,
            };
            let qos = QosProfile::keep_last(depth).latching(true);
            match system.bus().advertise(&key.0, of, qos).await {
                Ok(publisher) => {
                    publisher.publish(message.bytes);
                    all.insert(key.clone(), (digest.clone(), publisher));
                }
                Err(error) => {
                    tracing::warn!(topic = %key.0, %error, "cannot publish latched messages to the local original");
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;

    fn message(publisher: &PeerId, number: u8) -> SerializedMessage {
        let wire_type = WireType::with_name("std_msgs/UInt8");
        SerializedMessage {
            bytes: Bytes::from(vec![number]),
            wire_type: Arc::new(wire_type),
            publisher: publisher.clone(),
            latching: true,
        }
    }

    #[tokio::test]
    async fn what_waits_for_an_advertisement_is_bounded_for_each_publisher() {
        let due = Arc::new(PendingLatched::default());
        let latched =
            LatchedRelay { due: due.clone(), task: tokio::spawn(std::future::pending::<()>()).abort_handle() };
        let topic: Arc<str> = "/map".into();
        let [quiet, busy, left] = ["/quiet", "/busy", "/left"].map(PeerId::from);
        latched.push(&topic, &message(&quiet, 1));
        for number in 0..100 {
            latched.push(&topic, &message(&busy, number));
            latched.push(&topic, &message(&left, number));
        }
        latched.remove_publisher(&topic, &left);
        let numbers = |news: LatchedUpdate| news.messages.map(|message| message.bytes[0]).collect::<Vec<_>>();
        // A publisher with many messages does not displace those of others.
        assert_eq!(numbers(due.next_update().await.1), [1]);
        assert_eq!(numbers(due.next_update().await.1), (84..100).collect::<Vec<_>>());
        let (key, news) = due.next_update().await;
        assert_eq!((&key.1, news.left, news.messages.len()), (&left, true, 0));
        assert!(due.state.lock().0.is_empty());
    }
}
