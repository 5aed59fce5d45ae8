//! The readers and writers of this node, which is what the others are told that it has.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;
use parking_lot::Mutex;
use rtps::{EndpointQos, Ends, Guid, SampleIdentity, SequenceNumber, Sink, Topic};
use tokio::sync::watch;

use super::bus::Inner;
use super::entities::Node;
use super::names::{self, Named};
use crate::bus::NodeNames;

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
    /// What the others are told: the nodes that this one stands for, or else this node, of this name. An end may be of several; what is of none is the
    /// node's of this name, or, where the program has called none so, the first one's.
    pub(super) fn nodes(&self, own: &str, others: &BTreeMap<String, NodeNames>) -> Vec<Node> {
        let mut nodes: BTreeMap<&str, Node> = BTreeMap::new();
        let mut names: Vec<&str> = others.keys().map(String::as_str).collect();
        let own = match names.first() {
            Some(first) if !names.contains(&own) => first,
            Some(_) => own,
            None => {
                names.push(own);
                own
            }
        };
        for name in names {
            let node = Node {
                name: name.into(),
                readers: Vec::new(),
                writers: Vec::new(),
            };
            nodes.insert(name, node);
        }
        let sides = [(&self.readers, false), (&self.writers, true)];
        for (guid, end, writes) in sides
            .into_iter()
            .flat_map(|(ends, writes)| ends.iter().map(move |(guid, end)| (guid, end, writes)))
        {
            let has = |names: &NodeNames| end.is_among(names, writes);
            let mut owners: Vec<&str> = others
                .iter()
                .filter(|(_, names)| has(names))
                .map(|(name, _)| name.as_str())
                .collect();
            if owners.is_empty() {
                owners.push(own);
            }
            for node in owners {
                if let Some(node) = nodes.get_mut(node) {
                    let ends = match writes {
                        true => &mut node.writers,
                        false => &mut node.readers,
                    };
                    ends.push(*guid);
                }
            }
        }
        nodes.into_values().collect()
    }
}

impl OwnEnd {
    /// Whether it is one of what a node has.
    fn is_among(&self, names: &NodeNames, writes: bool) -> bool {
        match (names::named(&self.topic), writes) {
            (Some(Named::Topic(name)), true) => names.publishes.contains(&name),
            (Some(Named::Topic(name)), false) => names.subscribes.contains(&name),
            // Those of clients are the other way round.
            (Some(Named::Request(name)), false) | (Some(Named::Reply(name)), true) => {
                names.serves.contains(&name)
            }
            _ => false,
        }
    }
}

/// The ends of this node.
#[derive(Default)]
pub(super) struct Own {
    ends: Mutex<OwnEnds>,
    /// Nodes that this one stands for, by name; it may be among them.
    others: Mutex<BTreeMap<String, NodeNames>>,
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

    /// Whose they are told to be from now on.
    pub(super) fn stand_for(&self, mut nodes: BTreeMap<String, NodeNames>) {
        nodes.retain(|name, _| names::is_global(name));
        *self.others.lock() = nodes;
        self.changes.send_modify(|number| *number += 1);
    }

    /// What the others are told of these.
    pub(super) fn told(&self, ends: &OwnEnds, own: &str) -> Vec<Node> {
        ends.nodes(own, &self.others.lock())
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ends_are_told_to_be_of_the_nodes_that_have_them() {
        let end = |number: u8, topic: &str| {
            let end = OwnEnd {
                topic: topic.to_owned(),
                type_name: "T".to_owned(),
            };
            (Guid::from([number; 16]), end)
        };
        let ends = OwnEnds {
            readers: [
                end(1, "rt/scan"),
                end(2, "rq/mouth/setRequest"),
                end(3, "rr/lent/setReply"),
            ]
            .into(),
            writers: [
                end(4, "rt/rosout"),
                end(5, "rr/mouth/setReply"),
                end(6, "rq/lent/setRequest"),
                end(7, "rt/scan"),
            ]
            .into(),
        };
        let set = |names: &[&str]| names.iter().map(ToString::to_string).collect();
        let ears = NodeNames {
            publishes: set(&["/rosout"]),
            subscribes: set(&["/scan"]),
            ..NodeNames::default()
        };
        let mouth = NodeNames {
            publishes: set(&["/rosout"]),
            // A client of what it calls so is none of its servers.
            serves: set(&["/mouth/set"]),
            ..NodeNames::default()
        };
        let told = |others: &BTreeMap<String, NodeNames>| {
            let numbers =
                |ends: &[Guid]| ends.iter().map(|guid| guid.bytes()[0]).collect::<Vec<_>>();
            let nodes = ends.nodes("/ears", others).into_iter();
            let node = |node: Node| {
                (
                    node.name.to_string(),
                    numbers(&node.readers),
                    numbers(&node.writers),
                )
            };
            nodes.map(node).collect::<Vec<_>>()
        };
        let ears_all = ("/ears".to_owned(), vec![1, 2, 3], vec![4, 5, 6, 7]);
        assert_eq!(told(&BTreeMap::new()), [ears_all]);
        let others = [("/ears".to_owned(), ears), ("/mouth".to_owned(), mouth)];
        // The program was told another name: no node of the stub's is there beside it.
        let bass = BTreeMap::from([("/bass".to_owned(), NodeNames::default())]);
        let bass_all = ("/bass".to_owned(), vec![1, 2, 3], vec![4, 5, 6, 7]);
        assert_eq!(told(&bass), [bass_all]);
        // What no node is said to have is the stub's own.
        let expected = [
            ("/ears".to_owned(), vec![1, 3], vec![4, 6, 7]),
            ("/mouth".to_owned(), vec![2], vec![4, 5]),
        ];
        assert_eq!(told(&others.into()), expected);
    }
}
