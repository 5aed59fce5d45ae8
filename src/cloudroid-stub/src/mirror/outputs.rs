//! What the real node publishes: advertised on the robot under this node's name.

use std::collections::HashMap;
use std::sync::Arc;

use link::control::{Control, Output};
use link::drops::Cause;
use link::record::Data;
use parking_lot::Mutex;
use ros::bus::{AdvertiseOptions, Message, Publisher, WireType};
use tokio::sync::Notify;
use tokio::task::AbortHandle;

use super::{Mirror, reports};

/// Messages kept for a slow subscriber.
const QUEUE: usize = 256;

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
    cloud: Arc<str>,
    channel: Mutex<u32>,
    publisher: Arc<dyn Publisher>,
    latched: Mutex<Latched>,
    /// A first latched message has come.
    news: Notify,
    counting: Mutex<Option<AbortHandle>>,
}

/// A latching topic has a second advertisement, which keeps the last message while somebody listens: without
/// listeners the cloud sends nothing, and what is kept would grow old.
#[derive(Default)]
enum Latched {
    #[default]
    Not,
    Asked(Vec<bytes::Bytes>),
    Kept(Box<dyn Publisher>),
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
            if !keeper.cloud_output(&topic.name, &message, phases) {
                return;
            }
        }
        let mut latched = topic.latched.lock();
        match &mut *latched {
            Latched::Kept(publisher) => publisher.publish(data.message),
            Latched::Asked(waiting) => waiting.push(data.message),
            Latched::Not if data.latching => {
                *latched = Latched::Asked(vec![data.message]);
                topic.news.notify_one();
            }
            Latched::Not => topic.publisher.publish(data.message),
        }
    }

    /// The topic of a channel.
    pub fn topic_of(&self, channel: u32) -> Option<String> {
        let channels = self.channels.lock();
        channels.get(&channel).map(|topic| topic.name.clone())
    }

    /// Publishes a message of this side, on a topic that is advertised.
    pub fn publish(&self, topic: &str, message: bytes::Bytes) {
        if let Some(topic) = self.topics.lock().get(topic) {
            topic.publisher.publish(message);
        }
    }

    /// The type of an output.
    pub fn wire_type(&self, topic: &str) -> Option<Arc<WireType>> {
        let topics = self.topics.lock();
        topics.get(topic).map(|topic| topic.wire_type.clone())
    }

    /// Advertises what is new and takes back what is gone.
    pub async fn apply(&self, mirror: &Arc<Mirror>, outputs: &[Output]) {
        self.topics.lock().retain(|name, topic| {
            let same = |output: &&Output| output.topic == *name && output.md5 == topic.md5;
            outputs.iter().any(|output| same(&output))
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
            channels.insert(output.channel, topic);
        }
        *self.channels.lock() = channels.clone();
        // Siblings may have changed, so who counts as a listener; a new session knows of none.
        for topic in channels.values() {
            count(mirror, topic);
        }
    }

    async fn advertise(&self, mirror: &Arc<Mirror>, output: &Output) -> Option<Arc<Topic>> {
        let key = (output.type_name.clone(), output.md5.clone());
        let wire_type = mirror.types.lock().get(&key).cloned().unwrap_or(WireType {
            name: output.type_name.clone(),
            md5: output.md5.clone(),
            definition: String::new(),
        });
        let options = AdvertiseOptions {
            wire_type: wire_type.clone(),
            latch: false,
            queue: QUEUE,
        };
        match mirror.bus.advertise(&output.topic, options).await {
            Ok(publisher) => {
                let topic = Arc::new(Topic {
                    name: output.topic.clone(),
                    md5: output.md5.clone(),
                    wire_type: Arc::new(wire_type),
                    cloud: "cloud".into(),
                    channel: Mutex::new(output.channel),
                    publisher: publisher.into(),
                    latched: Mutex::default(),
                    news: Notify::new(),
                    counting: Mutex::default(),
                });
                let counted = Arc::downgrade(&topic.publisher);
                mirror.drops.ask(&output.topic, Cause::Slow, move || {
                    let publisher = counted.upgrade();
                    let count = publisher.as_ref().map_or(0, |it| it.dropped());
                    (count, publisher.is_none())
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
    let mut subscribers = topic.publisher.subscribers();
    let task = tokio::spawn(async move {
        let mut told = None;
        loop {
            subscribers.borrow_and_update();
            {
                let (Some(mirror), Some(topic)) = (mirror.upgrade(), of.upgrade()) else {
                    return;
                };
                let names = topic.publisher.subscriber_names();
                let siblings = mirror.siblings.read().clone();
                let count = names
                    .iter()
                    .filter(|name| !siblings.contains(*name))
                    .count();
                if told != Some(count) {
                    told = Some(count);
                    if let Some(keeper) = mirror.keeper() {
                        keeper.wanted(&topic.name, count > 0);
                    }
                    if count == 0 {
                        *topic.latched.lock() = Latched::Not;
                    }
                    let channel = *topic.channel.lock();
                    mirror
                        .session()
                        .tell(&Control::Listeners { channel, count });
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
    if !matches!(&*topic.latched.lock(), Latched::Asked(_)) {
        return;
    }
    let name = mirror
        .outputs
        .topics
        .lock()
        .iter()
        .find_map(|(name, known)| Arc::ptr_eq(known, topic).then(|| name.clone()));
    let Some(name) = name else { return };
    let wire_type = mirror
        .types
        .lock()
        .values()
        .find(|known| known.md5 == topic.md5)
        .cloned();
    let Some(wire_type) = wire_type else { return };
    let options = AdvertiseOptions {
        wire_type,
        latch: true,
        queue: QUEUE,
    };
    if let Ok(publisher) = mirror.bus.advertise(&name, options).await {
        let mut latched = topic.latched.lock();
        if let Latched::Asked(waiting) = &mut *latched {
            for message in waiting.drain(..) {
                publisher.publish(message);
            }
            *latched = Latched::Kept(publisher);
        }
    }
}
