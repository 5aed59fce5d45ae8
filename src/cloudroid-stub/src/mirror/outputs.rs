//! What the real node publishes: advertised on the robot under this node's name.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use bytes::Bytes;
use link::control::{FromRobot, Output};
use link::drops::Cause;
use link::record::Data;
use parking_lot::Mutex;
use qos::Side;
use ros::bus::{Message, PeerId, Publisher, Qos, WireType};
use ros::ring::{Bounds, Ring};
use tokio::sync::Notify;
use tokio::task::AbortHandle;

use super::{Mirror, reports};

/// Messages kept for a slow subscriber.
const QUEUE: usize = 256;
/// The channel of outputs that the cloud has not told of.
pub const NOWHERE: u32 = u32::MAX;

/// Outputs, by topic and by channel.
#[derive(Default)]
pub struct Outputs {
    topics: Mutex<HashMap<String, Arc<Topic>>>,
    channels: Mutex<HashMap<u32, Arc<Topic>>>,
}

struct Topic {
    name: String,
    md5: String,
    wire_type: Arc<WireType>,
    /// Who publishes what comes from the cloud.
    cloud: PeerId,
    channel: Mutex<u32>,
    publisher: Arc<dyn Publisher>,
    latched: Mutex<Latched>,
    /// Who listens on the robot, other nodes of the servant not counted.
    listeners: AtomicUsize,
    /// A first latched message has come.
    news: Notify,
    counting: Mutex<Option<AbortHandle>>,
}

/// Latched messages for new subscribers: the last one of the side (cloud or original) that answers for the node.
#[derive(Default)]
struct Latched {
    /// What each side has latched last. Of the cloud only while somebody listens: else it sends nothing, and what is
    /// kept would grow old.
    last: [Option<Bytes>; 2],
    advertised: Advertised,
    /// Messages dropped by advertisements that have ended, and before there was one.
    dropped: u64,
}

/// A latching topic has a second advertisement.
#[derive(Default)]
enum Advertised {
    #[default]
    Not,
    /// It has been asked for; until it is there, messages wait.
    Asked(Ring<Bytes>),
    Kept(Box<dyn Publisher>),
}

impl Latched {
    fn become_advertised(&mut self, advertised: Advertised) {
        if let Advertised::Kept(ended) = std::mem::replace(&mut self.advertised, advertised) {
            self.dropped += ended.dropped();
        }
    }

    fn dropped(&self) -> u64 {
        let now = match &self.advertised {
            Advertised::Kept(publisher) => publisher.dropped(),
            _ => 0,
        };
        self.dropped + now
    }
}

impl Topic {
    /// Messages that whoever listens was too slow for.
    fn dropped(&self) -> u64 {
        self.publisher.dropped() + self.latched.lock().dropped()
    }

    /// A side has published; `heard`: it answers for the node.
    fn take(&self, side: Side, message: Bytes, latching: bool, heard: bool) {
        let mut latched = self.latched.lock();
        if latching {
            latched.last[side.index()] = Some(message.clone());
        }
        if heard {
            self.publish(&mut latched, message, latching);
        }
    }

    fn publish(&self, latched: &mut Latched, message: Bytes, latching: bool) {
        match &mut latched.advertised {
            Advertised::Kept(publisher) => publisher.publish(message),
            Advertised::Asked(waiting) => {
                latched.dropped += waiting.push(message).messages;
            }
            Advertised::Not if latching => {
                let mut waiting = Ring::new(Bounds::messages(QUEUE));
                latched.dropped += waiting.push(message).messages;
                latched.become_advertised(Advertised::Asked(waiting));
                self.news.notify_one();
            }
            Advertised::Not => self.publisher.publish(message),
        }
    }

    /// This side speaks for the node from now on.
    fn speaks(&self, side: Side) {
        let mut latched = self.latched.lock();
        match latched.last[side.index()].clone() {
            Some(message) => self.publish(&mut latched, message, true),
            // The cloud will be asked when somebody listens; until it has latched something, what was heard last stays.
            None if side == Side::Cloud && self.listeners.load(Ordering::Relaxed) == 0 => {
                latched.become_advertised(Advertised::Not);
            }
            None => {}
        }
    }

    /// There are no subscribers any more.
    fn is_left(&self, local_speaks: bool) {
        let mut latched = self.latched.lock();
        latched.last[Side::Cloud.index()] = None;
        let kept = local_speaks && latched.last[Side::Local.index()].is_some();
        if !kept {
            latched.become_advertised(Advertised::Not);
        }
    }
}

impl Drop for Topic {
    fn drop(&mut self) {
        if let Some(counting) = self.counting.lock().take() {
            counting.abort();
        }
    }
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
            topic.latched.lock().last[Side::Local.index()] = None;
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
            topic.publisher.publish(message);
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
            listed.map_or(keeps, |output| output.md5 == topic.md5)
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
        let key = (output.type_name.clone(), output.md5.clone());
        let known = mirror.types.lock().get(&key).cloned();
        let of = known.unwrap_or_else(|| WireType::new(&output.type_name, &output.md5, ""));
        let qos = Qos::keep_last(QUEUE);
        match mirror.bus.advertise(&output.topic, of.clone(), qos).await {
            Ok(publisher) => {
                let topic = Arc::new(Topic {
                    name: output.topic.clone(),
                    md5: output.md5.clone(),
                    wire_type: Arc::new(of),
                    cloud: "cloud".into(),
                    channel: Mutex::new(output.channel),
                    publisher: publisher.into(),
                    latched: Mutex::default(),
                    listeners: AtomicUsize::new(0),
                    news: Notify::new(),
                    counting: Mutex::default(),
                });
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
    let mut subscribers = topic.publisher.matched();
    let task = tokio::spawn(async move {
        let mut told = None;
        loop {
            let matched = subscribers.borrow_and_update().clone();
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
                keep_latched(&mirror, &topic).await;
            }
            let Some(topic) = of.upgrade() else { return };
            tokio::select! {
                changed = subscribers.changed() => if changed.is_err() { return },
                () = topic.news.notified() => {}
            }
        }
    });
    if let Some(earlier) = topic.counting.lock().replace(task.abort_handle()) {
        earlier.abort();
    }
}

/// Adds the latching advertisement once a latched message has come, before the next newcomer.
async fn keep_latched(mirror: &Arc<Mirror>, topic: &Arc<Topic>) {
    if !matches!(topic.latched.lock().advertised, Advertised::Asked(_)) {
        return;
    }
    let name = mirror
        .outputs
        .topics
        .lock()
        .iter()
        .find_map(|(name, known)| Arc::ptr_eq(known, topic).then(|| name.clone()));
    let wire_type = mirror
        .types
        .lock()
        .values()
        .find(|known| known.digest == *topic.md5)
        .cloned();
    let advertised = match (name, wire_type) {
        (Some(name), Some(wire_type)) => {
            let qos = Qos::keep_last(QUEUE).latching(true);
            mirror.bus.advertise(&name, wire_type, qos).await.ok()
        }
        _ => None,
    };
    let mut latched = topic.latched.lock();
    let Advertised::Asked(waiting) = &mut latched.advertised else {
        return;
    };
    let waiting: Vec<Bytes> = waiting.collect();
    // Without one they are heard all the same; the next latched message asks again.
    let publisher: &dyn Publisher = match &advertised {
        Some(publisher) => publisher.as_ref(),
        None => topic.publisher.as_ref(),
    };
    for message in waiting {
        publisher.publish(message);
    }
    latched.become_advertised(match advertised {
        Some(publisher) => Advertised::Kept(publisher),
        None => Advertised::Not,
    });
}
