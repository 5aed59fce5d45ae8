//! Topics with serialized messages, for the parts of an action. Unlike other endpoints of this node these hear each
//! other, because an action's client may have its server behind the same bus.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use parking_lot::Mutex;
use ros_bus::{BusError, QosProfile, WireType};
use rtps::{Guid, ReceivedSample, Sink, TopicDescription};
use tokio::time::timeout;

use super::ends::{ReaderEnd, WriterEnd};
use super::names;
use super::quality::{self, Quality};
use super::state::Ros2BusState;

/// Receives messages of a topic, in order per writer. Must not block.
pub(super) trait RawListener: Send + Sync + 'static {
    /// A message arrived: CDR with its header.
    fn on_message(&self, payload: Bytes);
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
        self.0.on_message(sample.payload);
    }
}

/// A reader; dropping it withdraws it.
pub(super) struct RawReader {
    bus: Arc<Ros2BusState>,
    topic: TopicDescription,
    end: ReaderEnd,
}

/// Creates a reader that delivers the topic of this name and type to `ear`.
///
/// # Errors
/// The type has no name in DDS.
pub(super) fn reader(
    bus: &Arc<Ros2BusState>,
    name: &str,
    of: &WireType,
    qos: &QosProfile,
    ear: Arc<dyn RawListener>,
) -> Result<RawReader, BusError> {
    let topic = names::topic(name, of)?;
    let requested = quality::reader_qos(Quality::from_qos(qos), qos.depth);
    let remote = Arc::new(RemoteSink(Arc::clone(&ear)));
    let end = ReaderEnd::open(bus, &topic, requested, remote);
    let guid = end.guid();
    let kept: Vec<Bytes> = bus.hub.with_topic(&topic, |local| {
        local.ears.push((guid, Arc::clone(&ear)));
        local.writers.values().flatten().cloned().collect()
    });
    if qos.is_latching() {
        for last in kept {
            ear.on_message(last);
        }
    }
    Ok(RawReader { bus: Arc::clone(bus), topic, end })
}

impl RawReader {
    fn guid(&self) -> Guid {
        self.end.guid()
    }

    /// Waits until the messages of a writer arrive here. A writer of this node is heard as soon as it exists; one of
    /// another node that does not acknowledge this reader is assumed to know it after the time `unsure`.
    pub(super) async fn wait_for_writer(&self, unsure: Duration) {
        if self.has_local_writer() {
            return;
        }
        let mut ends = self.end.ends();
        drop(ends.wait_for(|ends| !ends.matched.is_empty()).await);
        let is_sure = ends.wait_for(|ends| !ends.confirmed.is_empty());
        drop(timeout(unsure, is_sure).await);
    }

    /// Returns true if there is a writer on this node, whose messages are delivered as well.
    fn has_local_writer(&self) -> bool {
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

/// Creates a writer of the topic of this name and type.
///
/// # Errors
/// The type has no name in DDS.
pub(super) fn writer(
    bus: &Arc<Ros2BusState>,
    name: &str,
    of: &WireType,
    qos: &QosProfile,
) -> Result<RawWriter, BusError> {
    let topic = names::topic(name, of)?;
    let end = WriterEnd::open(bus, &topic, quality::writer_qos(qos));
    let guid = end.guid();
    bus.hub.with_topic(&topic, |local| drop(local.writers.insert(guid, None)));
    Ok(RawWriter { bus: Arc::clone(bus), topic, keeps: qos.is_latching(), end })
}

impl RawWriter {
    fn guid(&self) -> Guid {
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
            ear.on_message(payload.clone());
        }
    }
}

impl Drop for RawWriter {
    fn drop(&mut self) {
        let guid = self.guid();
        self.bus.hub.with_topic(&self.topic, |local| drop(local.writers.remove(&guid)));
    }
}
