//! Topics by their DDS names, for the parts of an action. Unlike other endpoints of this node these hear each other,
//! because an action's client may have its server behind the same bus.

use std::collections::HashMap;
use std::sync::Arc;

use bytes::Bytes;
use parking_lot::Mutex;
use rtps::{DurabilityKind, EndpointMatches, EndpointQos, Guid, ReceivedSample, Sink, TopicDescription};
use tokio::sync::watch;

use super::ends::{ReaderEnd, WriterEnd};
use super::state::Ros2BusState;

/// Receives messages of a topic, in order per writer. Must not block.
pub(super) trait RawListener: Send + Sync + 'static {
    /// A message arrived: CDR with its header. If it is from this node, the writer's prefix is that of the participant.
    fn on_message(&self, payload: Bytes, writer: Guid);
}

/// Endpoints of this node that hear each other, by topic and type.
#[derive(Default)]
pub(super) struct Hub {
    topics: Mutex<HashMap<(String, String), LocalTopic>>,
}

#[derive(Default)]
struct LocalTopic {
    ears: Vec<(Guid, Arc<dyn RawListener>)>,
    /// Writers of this node, each with the message kept for late subscribers.
    writers: HashMap<Guid, Option<Bytes>>,
}

impl Hub {
    fn with_topic<T>(&self, topic: &TopicDescription, by: impl FnOnce(&mut LocalTopic) -> T) -> T {
        let key = (topic.name.clone(), topic.type_name.clone());
        let mut topics = self.topics.lock();
        let local = topics.entry(key.clone()).or_default();
        let done = by(local);
        if local.ears.is_empty() && local.writers.is_empty() {
            topics.remove(&key);
        }
        done
    }
}

/// Receives messages from DDS.
struct RemoteSink(Arc<dyn RawListener>);

impl Sink for RemoteSink {
    fn on_sample(&self, sample: ReceivedSample) {
        self.0.on_message(sample.payload, sample.writer);
    }
}

/// A reader; dropping it withdraws it.
pub(super) struct RawReader {
    bus: Arc<Ros2BusState>,
    topic: TopicDescription,
    end: ReaderEnd,
}

/// Creates a reader that delivers a topic to `ear`.
pub(super) fn reader(
    bus: &Arc<Ros2BusState>,
    topic: &TopicDescription,
    qos: EndpointQos,
    ear: Arc<dyn RawListener>,
) -> RawReader {
    let end = ReaderEnd::open(bus, topic, qos, Arc::new(RemoteSink(Arc::clone(&ear))));
    let guid = end.guid();
    let kept: Vec<(Guid, Bytes)> = bus.hub.with_topic(topic, |local| {
        local.ears.push((guid, Arc::clone(&ear)));
        let kept = local.writers.iter();
        kept.filter_map(|(writer, last)| Some((*writer, last.clone()?))).collect()
    });
    if qos.durability >= DurabilityKind::TransientLocal {
        for (writer, last) in kept {
            ear.on_message(last, writer);
        }
    }
    RawReader { bus: Arc::clone(bus), topic: topic.clone(), end }
}

impl RawReader {
    /// Returns the GUID.
    pub(super) fn guid(&self) -> Guid {
        self.end.guid()
    }

    /// Returns the matched writers of other nodes.
    pub(super) fn ends(&self) -> watch::Receiver<Arc<EndpointMatches>> {
        self.end.ends()
    }

    /// Returns true if there is a writer on this node, whose messages are delivered as well.
    pub(super) fn has_local_writer(&self) -> bool {
        let writers = |local: &mut LocalTopic| !local.writers.is_empty();
        self.bus.hub.with_topic(&self.topic, writers)
    }
}

impl Drop for RawReader {
    fn drop(&mut self) {
        let guid = self.guid();
        self.bus.hub.with_topic(&self.topic, |local| {
            local.ears.retain(|(ear, _)| *ear != guid);
        });
    }
}

/// A writer; dropping it withdraws it.
pub(super) struct RawWriter {
    bus: Arc<Ros2BusState>,
    topic: TopicDescription,
    keeps: bool,
    end: WriterEnd,
}

/// Creates a writer of a topic.
pub(super) fn writer(bus: &Arc<Ros2BusState>, topic: &TopicDescription, qos: EndpointQos) -> RawWriter {
    let end = WriterEnd::open(bus, topic, qos);
    let guid = end.guid();
    bus.hub.with_topic(topic, |local| drop(local.writers.insert(guid, None)));
    RawWriter {
        bus: Arc::clone(bus),
        topic: topic.clone(),
        keeps: qos.durability >= DurabilityKind::TransientLocal,
        end,
    }
}

impl RawWriter {
    /// Returns the GUID.
    pub(super) fn guid(&self) -> Guid {
        self.end.guid()
    }

    /// Sends a message: CDR with its header.
    pub(super) fn write(&self, payload: Bytes) {
        let guid = self.guid();
        self.end.write(payload.clone());
        let ears: Vec<Arc<dyn RawListener>> = self.bus.hub.with_topic(&self.topic, |local| {
            if self.keeps {
                local.writers.insert(guid, Some(payload.clone()));
            }
            local.ears.iter().map(|(_, ear)| Arc::clone(ear)).collect()
        });
        // Outside of the lock: a listener may write in turn.
        for ear in ears {
            ear.on_message(payload.clone(), guid);
        }
    }
}

impl Drop for RawWriter {
    fn drop(&mut self) {
        let guid = self.guid();
        self.bus.hub.with_topic(&self.topic, |local| drop(local.writers.remove(&guid)));
    }
}
