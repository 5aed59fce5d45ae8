//! The readers and writers of this node, which are announced to other nodes.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;
use parking_lot::Mutex;
use ros_bus::NodeNames;
use rtps::{EndpointMatches, EndpointQos, Guid, SampleIdentity, SequenceNumber, Sink, TopicDescription};
use tokio::sync::watch;

use super::entities::DiscoveredNode;
use super::names::{self, RosTopicRole};
use super::state::Ros2BusState;

/// One endpoint of this node.
#[derive(Debug, Clone)]
pub(super) struct LocalEndpoint {
    /// Name in DDS.
    pub(super) topic: String,
    /// Type name in DDS.
    pub(super) type_name: String,
}

/// Snapshot of this node's endpoints.
#[derive(Debug, Clone, Default)]
pub(super) struct LocalEndpoints {
    pub(super) readers: BTreeMap<Guid, LocalEndpoint>,
    pub(super) writers: BTreeMap<Guid, LocalEndpoint>,
}

impl LocalEndpoints {
    /// Returns the nodes to announce: the nodes that this one represents or, without any, the node `own`. An endpoint
    /// may belong to several of them; one that belongs to none is attributed to the node `own` or, if the program has
    /// no node of that name, to the first one.
    pub(super) fn nodes(&self, own: &str, others: &BTreeMap<String, NodeNames>) -> Vec<DiscoveredNode> {
        let mut nodes: BTreeMap<&str, DiscoveredNode> = BTreeMap::new();
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
            let node = DiscoveredNode { name: name.into(), readers: Vec::new(), writers: Vec::new() };
            nodes.insert(name, node);
        }
        let sides = [(&self.readers, false), (&self.writers, true)];
        for (guid, end, writes) in
            sides.into_iter().flat_map(|(ends, writes)| ends.iter().map(move |(guid, end)| (guid, end, writes)))
        {
            let has = |names: &NodeNames| end.belongs_to(names, writes);
            let mut owners: Vec<&str> =
                others.iter().filter(|(_, names)| has(names)).map(|(name, _)| name.as_str()).collect();
            if owners.is_empty() {
                owners.push(own);
            }
            for node in owners {
                if let Some(node) = nodes.get_mut(node) {
                    let ends = if writes { &mut node.writers } else { &mut node.readers };
                    ends.push(*guid);
                }
            }
        }
        nodes.into_values().collect()
    }
}

impl LocalEndpoint {
    /// Returns true if the endpoint is one of those that a node has.
    fn belongs_to(&self, names: &NodeNames, writes: bool) -> bool {
        match (names::topic_role(&self.topic), writes) {
            (Some(RosTopicRole::Topic(name)), true) => names.publishes.contains(&name),
            (Some(RosTopicRole::Topic(name)), false) => names.subscribes.contains(&name),
            // The endpoints of clients are the other way round.
            (Some(RosTopicRole::Request(name)), false) | (Some(RosTopicRole::Reply(name)), true) => {
                names.serves.contains(&name)
            }
            _ => false,
        }
    }
}

/// Table of this node's endpoints.
#[derive(Default)]
pub(super) struct LocalEndpointTable {
    ends: Mutex<LocalEndpoints>,
    /// Represented nodes, by name; may include this one.
    others: Mutex<BTreeMap<String, NodeNames>>,
    changes: watch::Sender<u64>,
}

impl LocalEndpointTable {
    /// Returns a counter of changes.
    pub(super) fn changes(&self) -> watch::Receiver<u64> {
        self.changes.subscribe()
    }

    /// Returns a snapshot of the endpoints.
    pub(super) fn ends(&self) -> LocalEndpoints {
        self.ends.lock().clone()
    }

    /// Sets the nodes to which the endpoints are attributed.
    pub(super) fn set_represented_nodes(&self, mut nodes: BTreeMap<String, NodeNames>) {
        nodes.retain(|name, _| names::is_global(name));
        *self.others.lock() = nodes;
        self.changes.send_modify(|number| *number += 1);
    }

    /// Returns the nodes to announce for these endpoints.
    pub(super) fn announced_nodes(&self, ends: &LocalEndpoints, own: &str) -> Vec<DiscoveredNode> {
        ends.nodes(own, &self.others.lock())
    }

    fn change(&self, by: impl FnOnce(&mut LocalEndpoints)) {
        by(&mut self.ends.lock());
        self.changes.send_modify(|number| *number += 1);
    }
}

fn local_endpoint(topic: &TopicDescription) -> LocalEndpoint {
    LocalEndpoint { topic: topic.name.clone(), type_name: topic.type_name.clone() }
}

/// A reader of this node, announced until it is dropped.
pub(super) struct ReaderEnd {
    bus: Arc<Ros2BusState>,
    reader: rtps::DataReader,
}

impl ReaderEnd {
    pub(super) fn open(
        bus: &Arc<Ros2BusState>,
        topic: &TopicDescription,
        qos: EndpointQos,
        sink: Arc<dyn Sink>,
    ) -> Self {
        let reader = bus.participant.reader(topic.clone(), qos, sink);
        let end = local_endpoint(topic);
        bus.own.change(|ends| drop(ends.readers.insert(reader.guid(), end)));
        let bus = Arc::clone(bus);
        Self { bus, reader }
    }

    pub(super) fn guid(&self) -> Guid {
        self.reader.guid()
    }

    pub(super) fn ends(&self) -> watch::Receiver<Arc<EndpointMatches>> {
        self.reader.watch_matches()
    }
}

impl Drop for ReaderEnd {
    fn drop(&mut self) {
        let guid = self.reader.guid();
        self.bus.own.change(|ends| drop(ends.readers.remove(&guid)));
    }
}

/// A writer of this node, announced until it is dropped.
pub(super) struct WriterEnd {
    bus: Arc<Ros2BusState>,
    writer: rtps::DataWriter,
}

impl WriterEnd {
    pub(super) fn open(bus: &Arc<Ros2BusState>, topic: &TopicDescription, qos: EndpointQos) -> Self {
        let writer = bus.participant.writer(topic.clone(), qos);
        let end = local_endpoint(topic);
        bus.own.change(|ends| drop(ends.writers.insert(writer.guid(), end)));
        let bus = Arc::clone(bus);
        Self { bus, writer }
    }

    pub(super) fn guid(&self) -> Guid {
        self.writer.guid()
    }

    pub(super) fn ends(&self) -> watch::Receiver<Arc<EndpointMatches>> {
        self.writer.watch_matches()
    }

    pub(super) fn write(&self, payload: Bytes) -> SequenceNumber {
        self.writer.write(payload)
    }

    pub(super) fn write_related(&self, payload: Bytes, related: SampleIdentity) -> SequenceNumber {
        self.writer.write_related(payload, related)
    }

    /// Sets how many of its last samples it gives to new readers.
    pub(super) fn set_kept(&self, samples: usize) {
        self.writer.set_kept(samples);
    }

    /// Returns the number of samples dropped for slow readers.
    pub(super) fn dropped_count(&self) -> u64 {
        self.writer.dropped_samples()
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
            let end = LocalEndpoint { topic: topic.to_owned(), type_name: "T".to_owned() };
            (Guid::from([number; 16]), end)
        };
        let ends = LocalEndpoints {
            readers: [end(1, "rt/scan"), end(2, "rq/mouth/setRequest"), end(3, "rr/lent/setReply")].into(),
            writers: [
                end(4, "rt/rosout"),
                end(5, "rr/mouth/setReply"),
                end(6, "rq/lent/setRequest"),
                end(7, "rt/scan"),
            ]
            .into(),
        };
        let set = |names: &[&str]| names.iter().map(ToString::to_string).collect();
        let ears = NodeNames { publishes: set(&["/rosout"]), subscribes: set(&["/scan"]), ..NodeNames::default() };
        let mouth = NodeNames {
            publishes: set(&["/rosout"]),
            // A client of the service is not one of its servers.
            serves: set(&["/mouth/set"]),
            ..NodeNames::default()
        };
        let told = |others: &BTreeMap<String, NodeNames>| {
            let numbers = |ends: &[Guid]| ends.iter().map(|guid| guid.bytes()[0]).collect::<Vec<_>>();
            let nodes = ends.nodes("/ears", others).into_iter();
            let node = |node: DiscoveredNode| (node.name.to_string(), numbers(&node.readers), numbers(&node.writers));
            nodes.map(node).collect::<Vec<_>>()
        };
        let ears_all = ("/ears".to_owned(), vec![1, 2, 3], vec![4, 5, 6, 7]);
        assert_eq!(told(&BTreeMap::new()), [ears_all]);
        let others = [("/ears".to_owned(), ears), ("/mouth".to_owned(), mouth)];
        // The program has another name: no node of the stub's name exists beside it.
        let bass = BTreeMap::from([("/bass".to_owned(), NodeNames::default())]);
        let bass_all = ("/bass".to_owned(), vec![1, 2, 3], vec![4, 5, 6, 7]);
        assert_eq!(told(&bass), [bass_all]);
        // Endpoints that no node is said to have are the stub's own.
        let expected = [("/ears".to_owned(), vec![1, 3], vec![4, 6, 7]), ("/mouth".to_owned(), vec![2], vec![4, 5])];
        assert_eq!(told(&others.into()), expected);
    }
}
