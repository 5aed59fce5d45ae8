//! Topics by their names in DDS, for the parts of an action. Unlike other ends of this node these hear each other, because an
//! action's client may have its server behind the same bus.

use std::collections::HashMap;
use std::sync::Arc;

use bytes::Bytes;
use parking_lot::Mutex;
use rtps::{Durability, EndpointQos, Ends, Guid, Sample, Sink, Topic};
use tokio::sync::watch;

use super::bus::Inner;
use super::ends::{ReaderEnd, WriterEnd};

/// Takes what comes by a topic, in the order of each writer. Must not block.
pub(super) trait Ear: Send + Sync + 'static {
    /// A message: CDR with its header. Of this node's own, the writer's prefix is that of the participant.
    fn hear(&self, payload: Bytes, writer: Guid);
}

/// Ends of this node that hear each other, by topic and type.
#[derive(Default)]
pub(super) struct Hub {
    topics: Mutex<HashMap<(String, String), Local>>,
}

#[derive(Default)]
struct Local {
    ears: Vec<(Guid, Arc<dyn Ear>)>,
    /// Writers of this node, with what they keep for those who come later.
    writers: HashMap<Guid, Option<Bytes>>,
}

impl Hub {
    fn change<T>(&self, topic: &Topic, by: impl FnOnce(&mut Local) -> T) -> T {
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

/// What DDS brings.
struct FromAfar(Arc<dyn Ear>);

impl Sink for FromAfar {
    fn sample(&self, sample: Sample) {
        self.0.hear(sample.payload, sample.writer);
    }
}

/// A reader; dropping it withdraws it.
pub(super) struct RawReader {
    bus: Arc<Inner>,
    topic: Topic,
    end: ReaderEnd,
}

/// Has a topic heard.
pub(super) fn reader(
    bus: &Arc<Inner>,
    topic: &Topic,
    qos: EndpointQos,
    ear: Arc<dyn Ear>,
) -> RawReader {
    let end = ReaderEnd::open(bus, topic, qos, Arc::new(FromAfar(Arc::clone(&ear))));
    let guid = end.guid();
    let kept: Vec<(Guid, Bytes)> = bus.hub.change(topic, |local| {
        local.ears.push((guid, Arc::clone(&ear)));
        let kept = local.writers.iter();
        kept.filter_map(|(writer, last)| Some((*writer, last.clone()?)))
            .collect()
    });
    if qos.durability >= Durability::TransientLocal {
        for (writer, last) in kept {
            ear.hear(last, writer);
        }
    }
    RawReader {
        bus: Arc::clone(bus),
        topic: topic.clone(),
        end,
    }
}

impl RawReader {
    /// Which end it is.
    pub(super) fn guid(&self) -> Guid {
        self.end.guid()
    }

    /// Writers of other nodes.
    pub(super) fn ends(&self) -> watch::Receiver<Arc<Ends>> {
        self.end.ends()
    }

    /// Whether there is a writer of this node, which is heard as well.
    pub(super) fn hears_own(&self) -> bool {
        let writers = |local: &mut Local| !local.writers.is_empty();
        self.bus.hub.change(&self.topic, writers)
    }
}

impl Drop for RawReader {
    fn drop(&mut self) {
        let guid = self.guid();
        self.bus.hub.change(&self.topic, |local| {
            local.ears.retain(|(ear, _)| *ear != guid);
        });
    }
}

/// A writer; dropping it withdraws it.
pub(super) struct RawWriter {
    bus: Arc<Inner>,
    topic: Topic,
    keeps: bool,
    end: WriterEnd,
}

/// Makes a writer of a topic.
pub(super) fn writer(bus: &Arc<Inner>, topic: &Topic, qos: EndpointQos) -> RawWriter {
    let end = WriterEnd::open(bus, topic, qos);
    let guid = end.guid();
    bus.hub
        .change(topic, |local| drop(local.writers.insert(guid, None)));
    RawWriter {
        bus: Arc::clone(bus),
        topic: topic.clone(),
        keeps: qos.durability >= Durability::TransientLocal,
        end,
    }
}

impl RawWriter {
    /// Which end it is.
    pub(super) fn guid(&self) -> Guid {
        self.end.guid()
    }

    /// Sends a message: CDR with its header.
    pub(super) fn write(&self, payload: Bytes) {
        let guid = self.guid();
        self.end.write(payload.clone());
        let ears: Vec<Arc<dyn Ear>> = self.bus.hub.change(&self.topic, |local| {
            if self.keeps {
                local.writers.insert(guid, Some(payload.clone()));
            }
            local.ears.iter().map(|(_, ear)| Arc::clone(ear)).collect()
        });
        // Outside of the lock: who hears something may write something.
        for ear in ears {
            ear.hear(payload.clone(), guid);
        }
    }
}

impl Drop for RawWriter {
    fn drop(&mut self) {
        let guid = self.guid();
        self.bus
            .hub
            .change(&self.topic, |local| drop(local.writers.remove(&guid)));
    }
}
