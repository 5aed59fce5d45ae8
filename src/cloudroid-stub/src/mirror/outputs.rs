//! What the real node publishes: advertised on the robot under this node's name.

mod topic;

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use bytes::Bytes;
use link::control::{FromRobot, Output};
use link::drops::Cause;
use link::record::Data;
use parking_lot::Mutex;
use qos::Side;
use ros::bus::{Message, WireType};

use self::topic::Topic;
use super::{Mirror, reports};

/// The channel of outputs that the cloud has not told of.
pub const NOWHERE: u32 = u32::MAX;

/// Outputs, by topic and by channel.
#[derive(Default)]
pub struct Outputs {
    topics: Mutex<HashMap<String, Arc<Topic>>>,
    channels: Mutex<HashMap<u32, Arc<Topic>>>,
}

impl Outputs {
    /// Publishes a message of the cloud.
    pub fn take(&self, mirror: &Mirror, data: Data, arrived: i64) {
        let Some(topic) = self.channels.lock().get(&data.channel).cloned() else {
            return;
        };
        let mut heard = true;
        if let Some(keeper) = mirror.keeper() {
            let message = Message {
                bytes: data.message.clone(),
                wire_type: topic.wire_type.clone(),
                publisher: topic.cloud.clone(),
                latching: data.latching,
            };
            let phases = mirror
                .session()
                .clock()
                .and_then(|clock| reports::of_output(&data, arrived, clock.offset));
            heard = keeper.cloud_output(&topic.name, &message, phases);
        }
        topic.take(Side::Cloud, data.message, data.latching, heard);
    }

    /// The local original has published; `heard`: it answers for the node.
    pub fn take_local(&self, topic: &str, message: Message, heard: bool) {
        let topic = self.topics.lock().get(topic).cloned();
        if let Some(topic) = topic {
            topic.take(Side::Local, message.bytes, message.latching, heard);
        }
    }

    /// This side speaks for the node from now on.
    pub fn speaks(&self, side: Side) {
        for topic in self.all() {
            topic.speaks(side);
        }
    }

    /// The local original has ended; its latched messages are dropped.
    pub fn local_ended(&self) {
        for topic in self.all() {
            topic.local_ended();
        }
    }

    fn all(&self) -> Vec<Arc<Topic>> {
        self.topics.lock().values().cloned().collect()
    }

    /// The topic of a channel.
    pub fn topic_of(&self, channel: u32) -> Option<String> {
        let channels = self.channels.lock();
        channels.get(&channel).map(|topic| topic.name.clone())
    }

    /// Publishes a message of this side, on a topic that is advertised.
    pub fn publish(&self, topic: &str, message: Bytes) {
        if let Some(topic) = self.topics.lock().get(topic) {
            topic.publisher().publish(message);
        }
    }

    /// The type of an output.
    pub fn wire_type(&self, topic: &str) -> Option<Arc<WireType>> {
        let topics = self.topics.lock();
        topics.get(topic).map(|topic| topic.wire_type.clone())
    }

    /// Advertises what is new and takes back what is gone, unless it `keeps` that for the time being.
    pub async fn apply(&self, mirror: &Arc<Mirror>, outputs: &[Output], keeps: bool) {
        self.topics.lock().retain(|name, topic| {
            let listed = outputs.iter().find(|output| output.topic == *name);
            listed.map_or(keeps, |output| topic.is(output))
        });
        let mut channels = HashMap::new();
        for output in outputs {
            let known = self.topics.lock().get(&output.topic).cloned();
            let topic = match known {
                Some(topic) => topic,
                None => match self.advertise(mirror, output).await {
                    Some(topic) => topic,
                    None => continue,
                },
            };
            *topic.channel.lock() = output.channel;
            // Siblings may have changed, so who counts as a listener; a new session knows of none.
            count(mirror, &topic);
            channels.insert(output.channel, topic);
        }
        channels.remove(&NOWHERE);
        *self.channels.lock() = channels;
    }

    async fn advertise(&self, mirror: &Arc<Mirror>, output: &Output) -> Option<Arc<Topic>> {
        let of = mirror.wire_type(&output.type_name, &output.md5);
        match Topic::advertise(&*mirror.bus, output, of).await {
            Ok(topic) => {
                let topic = Arc::new(topic);
                let counted = Arc::downgrade(&topic);
                mirror.drops.ask(&output.topic, Cause::Slow, move || {
                    let topic = counted.upgrade();
                    (topic.as_ref().map_or(0, |it| it.dropped()), topic.is_none())
                });
                self.topics
                    .lock()
                    .insert(output.topic.clone(), topic.clone());
                Some(topic)
            }
            Err(error) => {
                tracing::warn!(topic = output.topic, %error, "cannot be advertised");
                None
            }
        }
    }
}

/// Tells the cloud how many listen, now and whenever that changes.
fn count(mirror: &Arc<Mirror>, topic: &Arc<Topic>) {
    let (mirror, of) = (Arc::downgrade(mirror), Arc::downgrade(topic));
    let mut subscribers = topic.publisher().matched();
    let refused = mirror
        .upgrade()
        .map(|mirror| mirror.refusals.end(&topic.name));
    // Not the topic itself: it is taken back when nobody but this task would hold it.
    let news = Arc::clone(&topic.news);
    let task = tokio::spawn(async move {
        let mut told = None;
        loop {
            let matched = subscribers.borrow_and_update().clone();
            if let Some(end) = &refused {
                end.meets(&matched);
            }
            {
                let (Some(mirror), Some(topic)) = (mirror.upgrade(), of.upgrade()) else {
                    return;
                };
                let siblings = mirror.siblings.read().clone();
                let others = matched.peers.iter();
                let others = others.filter(|peer| !siblings.contains(peer.id.node()));
                let count = others.count();
                if told != Some(count) {
                    told = Some(count);
                    topic.listeners.store(count, Ordering::Relaxed);
                    if let Some(keeper) = mirror.keeper() {
                        keeper.wanted(&topic.name, count > 0);
                    }
                    if count == 0 {
                        topic.is_left(mirror.keeper().is_some_and(|keeper| keeper.is_local_fed()));
                    }
                    let channel = *topic.channel.lock();
                    if channel != NOWHERE {
                        mirror
                            .session()
                            .report(&FromRobot::Listeners { channel, count });
                    }
                }
                if topic.keep_latched(&*mirror.bus).await {
                    subscribers = topic.publisher().matched();
                    continue;
                }
            }
            tokio::select! {
                changed = subscribers.changed() => if changed.is_err() { return },
                () = news.notified() => {}
            }
        }
    });
    if let Some(earlier) = topic.counting.lock().replace(task.abort_handle()) {
        earlier.abort();
    }
}
