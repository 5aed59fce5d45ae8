//! The readers and writers of this node, which is what the others are told that it has.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;
use parking_lot::Mutex;
use rtps::{EndpointQos, Ends, Guid, SampleIdentity, SequenceNumber, Sink, Topic};
use tokio::sync::watch;

use super::bus::Inner;
use super::entities::Node;

/// One end of this node.
#[derive(Debug, Clone)]
pub(super) struct OwnEnd {
    /// As DDS has it.
    pub(super) topic: String,
    /// As DDS has it.
    pub(super) type_name: String,
}

/// The ends of this node at one moment.
#[derive(Debug, Clone, Default)]
pub(super) struct OwnEnds {
    pub(super) readers: BTreeMap<Guid, OwnEnd>,
    pub(super) writers: BTreeMap<Guid, OwnEnd>,
}

impl OwnEnds {
    /// What the others are told.
    pub(super) fn node(&self, name: &str) -> Node {
        Node {
            name: name.into(),
            readers: self.readers.keys().copied().collect(),
            writers: self.writers.keys().copied().collect(),
        }
    }
}

/// The ends of this node.
#[derive(Default)]
pub(super) struct Own {
    ends: Mutex<OwnEnds>,
    changes: watch::Sender<u64>,
}

impl Own {
    /// Changes with every change.
    pub(super) fn changes(&self) -> watch::Receiver<u64> {
        self.changes.subscribe()
    }

    /// All of them now.
    pub(super) fn ends(&self) -> OwnEnds {
        self.ends.lock().clone()
    }

    fn change(&self, by: impl FnOnce(&mut OwnEnds)) {
        by(&mut self.ends.lock());
        self.changes.send_modify(|number| *number += 1);
    }
}

fn own_end(topic: &Topic) -> OwnEnd {
    OwnEnd {
        topic: topic.name.clone(),
        type_name: topic.type_name.clone(),
    }
}

/// A reader of this node, until it is dropped.
pub(super) struct ReaderEnd {
    bus: Arc<Inner>,
    reader: rtps::Reader,
}

impl ReaderEnd {
    pub(super) fn open(
        bus: &Arc<Inner>,
        topic: &Topic,
        qos: EndpointQos,
        sink: Arc<dyn Sink>,
    ) -> Self {
        let reader = bus.participant.reader(topic.clone(), qos, sink);
        let end = own_end(topic);
        bus.own
            .change(|ends| drop(ends.readers.insert(reader.guid(), end)));
        let bus = Arc::clone(bus);
        Self { bus, reader }
    }

    pub(super) fn guid(&self) -> Guid {
        self.reader.guid()
    }

    pub(super) fn ends(&self) -> watch::Receiver<Arc<Ends>> {
        self.reader.ends()
    }
}

impl Drop for ReaderEnd {
    fn drop(&mut self) {
        let guid = self.reader.guid();
        self.bus.own.change(|ends| drop(ends.readers.remove(&guid)));
    }
}

/// A writer of this node, until it is dropped.
pub(super) struct WriterEnd {
    bus: Arc<Inner>,
    writer: rtps::Writer,
}

impl WriterEnd {
    pub(super) fn open(bus: &Arc<Inner>, topic: &Topic, qos: EndpointQos) -> Self {
        let writer = bus.participant.writer(topic.clone(), qos);
        let end = own_end(topic);
        bus.own
            .change(|ends| drop(ends.writers.insert(writer.guid(), end)));
        let bus = Arc::clone(bus);
        Self { bus, writer }
    }

    pub(super) fn guid(&self) -> Guid {
        self.writer.guid()
    }

    pub(super) fn ends(&self) -> watch::Receiver<Arc<Ends>> {
        self.writer.ends()
    }

    pub(super) fn write(&self, payload: Bytes) -> SequenceNumber {
        self.writer.write(payload)
    }

    pub(super) fn write_related(&self, payload: Bytes, related: SampleIdentity) -> SequenceNumber {
        self.writer.write_related(payload, related)
    }

    /// Samples that a slow reader was not given.
    pub(super) fn dropped(&self) -> u64 {
        self.writer.dropped()
    }
}

impl Drop for WriterEnd {
    fn drop(&mut self) {
        let guid = self.writer.guid();
        self.bus.own.change(|ends| drop(ends.writers.remove(&guid)));
    }
}
