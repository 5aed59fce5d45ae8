//! Keeps the messages that the robot's publishers have latched, for the local original. Each publisher gets an advertisement of
//! its own in the private ROS system, so that a process that starts later gets all of them.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;

use parking_lot::Mutex;
use ros::bus::{Digest, Message, PeerId, Publisher, Qos, RosVersion, WireType};
use ros::ring::{Bounds, Ring};
use tokio::sync::Notify;
use tokio::task::AbortHandle;

use super::private_system::PrivateSystem;

/// Messages of one publisher kept for a process that is slow, and while its advertisement is made; a newcomer is given the
/// last one of each publisher.
const QUEUE: usize = 16;

/// A handle; the advertisements end with it.
pub struct Latched {
    due: Arc<Due>,
    task: AbortHandle,
}

/// A topic and one of its publishers.
type Key = (Arc<str>, PeerId);

/// What was not passed on yet: by publisher, in the order in which publishers were first heard.
#[derive(Default)]
struct Due {
    state: Mutex<(HashMap<Key, News>, VecDeque<Key>)>,
    ready: Notify,
}

/// What is new about one publisher.
struct News {
    /// It has left: what it latched before does not count any more.
    left: bool,
    messages: Ring<Message>,
}

impl Due {
    fn add(&self, topic: &Arc<str>, publisher: &PeerId, news: impl FnOnce(&mut News)) {
        {
            let (known, turns) = &mut *self.state.lock();
            let key = (topic.clone(), publisher.clone());
            let of = known.entry(key.clone()).or_insert_with(|| {
                turns.push_back(key);
                News {
                    left: false,
                    messages: Ring::new(Bounds::messages(QUEUE)),
                }
            });
            news(of);
        }
        self.ready.notify_one();
    }

    async fn next(&self) -> (Key, News) {
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

impl Drop for Latched {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Latched {
    pub fn begin(system: &Arc<PrivateSystem>) -> Self {
        let due = Arc::new(Due::default());
        let task = tokio::spawn(serve(system.clone(), due.clone())).abort_handle();
        Self { due, task }
    }

    /// Keeps a message of a publisher that latches.
    pub fn keep(&self, topic: &Arc<str>, message: &Message) {
        self.due.add(topic, &message.publisher, |news| {
            let lost = news.messages.push(message.clone());
            if lost.messages > 0 {
                tracing::debug!(%topic, dropped = lost.messages, "newer latched messages took the place of older ones");
            }
        });
    }

    /// The publisher has unregistered or ended.
    pub fn forget(&self, topic: &Arc<str>, publisher: &PeerId) {
        self.due.add(topic, publisher, |news| {
            news.left = true;
            news.messages.clear();
        });
    }
}

/// The digest of each publisher's type, and who repeats it here.
type Repeated = HashMap<Key, (Digest, Box<dyn Publisher>)>;

/// Serves one publisher after the other; only its first message takes time, for the advertisement.
async fn serve(system: Arc<PrivateSystem>, due: Arc<Due>) {
    let mut all = Repeated::new();
    loop {
        let (key, news) = due.next().await;
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
                // Here a publisher gives newcomers all that it keeps.
                RosVersion::Two => 1,
            };
            let qos = Qos::keep_last(depth).latching(true);
            match system.bus().advertise(&key.0, of, qos).await {
                Ok(publisher) => {
                    publisher.publish(message.bytes);
                    all.insert(key.clone(), (digest.clone(), publisher));
                }
                Err(error) => {
                    tracing::warn!(topic = %key.0, %error, "the local original is not given what is latched there");
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;

    fn message(publisher: &PeerId, number: u8) -> Message {
        let wire_type = WireType::named("std_msgs/UInt8");
        Message {
            bytes: Bytes::from(vec![number]),
            wire_type: Arc::new(wire_type),
            publisher: publisher.clone(),
            latching: true,
        }
    }

    #[tokio::test]
    async fn what_waits_for_an_advertisement_is_bounded_for_each_publisher() {
        let due = Arc::new(Due::default());
        let latched = Latched {
            due: due.clone(),
            task: tokio::spawn(std::future::pending::<()>()).abort_handle(),
        };
        let topic: Arc<str> = "/map".into();
        let [quiet, busy, left] = ["/quiet", "/busy", "/left"].map(PeerId::from);
        latched.keep(&topic, &message(&quiet, 1));
        for number in 0..100 {
            latched.keep(&topic, &message(&busy, number));
            latched.keep(&topic, &message(&left, number));
        }
        latched.forget(&topic, &left);
        let numbers = |news: News| {
            news.messages
                .map(|message| message.bytes[0])
                .collect::<Vec<_>>()
        };
        // Whoever publishes much takes nothing from whoever publishes little.
        assert_eq!(numbers(due.next().await.1), [1]);
        assert_eq!(numbers(due.next().await.1), (84..100).collect::<Vec<_>>());
        let (key, news) = due.next().await;
        assert_eq!((&key.1, news.left, news.messages.len()), (&left, true, 0));
        assert!(due.state.lock().0.is_empty());
    }
}
