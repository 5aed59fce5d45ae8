//! The ROS graph: nodes and what they have registered.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::hidden_names::action_part_name;
use crate::{QosProfile, ServiceType, WireType, enclave_for, linked_node};

/// A snapshot of what nodes have registered.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Graph {
    /// Number of changes so far.
    pub generation: u64,
    /// Topic → its type, publishers and subscribers. Where actions consist of topics (ROS 1), those are included.
    pub topics: BTreeMap<String, TopicNodes>,
    /// Service → the node that serves it.
    pub services: BTreeMap<String, String>,
    /// Action → its type, servers and clients.
    pub actions: BTreeMap<String, ActionNodes>,
    /// Node → its address: an XML-RPC URI (ROS 1) or a GUID (ROS 2).
    pub nodes: BTreeMap<String, String>,
    /// Every global parameter that a node has read or written, with those nodes.
    pub parameters: BTreeMap<String, ParameterUse>,
    /// Services that nodes looked up without finding a server, with those nodes. Filled in by our own Master and by ROS
    /// 2.
    pub sought: BTreeMap<String, Vec<String>>,
    /// Node → all its endpoints, including those that tools hide, such as the parts of actions. ROS 2 only.
    pub ends: BTreeMap<String, NodeEntities>,
    /// Enclave that processes were started with (`--enclave`) → their nodes, for all enclaves but the root. ROS 2 only.
    pub enclaves: BTreeMap<String, BTreeSet<String>>,
}

/// Queries. Items hidden from tools (a part of the name begins with `_`) are found in [`Graph::ends`] only.
impl Graph {
    /// Returns true if there is a node of this name.
    pub fn has_node(&self, node: &str) -> bool {
        self.nodes.contains_key(node) || self.ends.contains_key(node)
    }

    /// Returns true if the node publishes the topic.
    pub fn publishes(&self, node: &str, topic: &str) -> bool {
        let shown = self.topics.get(topic);
        let ends = self.ends.get(node);
        shown.is_some_and(|ends| ends.publishers.iter().any(|it| it == node))
            || ends.is_some_and(|ends| ends.publishers.contains_key(topic))
    }

    /// Returns true if the node subscribes to the topic.
    pub fn subscribes(&self, node: &str, topic: &str) -> bool {
        let shown = self.topics.get(topic);
        let ends = self.ends.get(node);
        shown.is_some_and(|ends| ends.subscribers.iter().any(|it| it == node))
            || ends.is_some_and(|ends| ends.subscribers.contains_key(topic))
    }

    /// Returns true if any node serves the service.
    pub fn serves(&self, service: &str) -> bool {
        let mut ends = self.ends.values();
        self.services.contains_key(service) || ends.any(|ends| ends.services.contains_key(service))
    }

    /// Returns true if any node serves the action.
    pub fn serves_action(&self, action: &str) -> bool {
        let shown = self.actions.get(action);
        shown.is_some_and(|ends| !ends.servers.is_empty()) || self.serves(&action_part_name(action, "send_goal"))
    }

    /// Returns the nodes of the process that a servant runs as the robot's node `node`: that node and, in ROS 2, all
    /// other nodes in the process's enclave. Nodes whose name also occurs in another process are excluded, since
    /// endpoints are attributed to nodes by name.
    pub fn process_nodes(&self, node: &str) -> BTreeSet<String> {
        let marked = self.enclave_nodes(node).into_iter().flatten();
        let own = marked.filter(|other| *other == node || !self.is_ambiguous(other));
        own.cloned().chain([node.to_owned()]).collect()
    }

    /// Returns true if `other` is a node of the process of `node` (see [`process_nodes`](Self::process_nodes)).
    pub fn is_in_process(&self, node: &str, other: &str) -> bool {
        let marked = || self.enclave_nodes(node);
        node == other || marked().is_some_and(|nodes| nodes.contains(other) && !self.is_ambiguous(other))
    }

    /// Returns the further nodes of that process that are not attributed to it because another process has a node of
    /// the same name.
    pub fn ambiguous_process_nodes(&self, node: &str) -> BTreeSet<String> {
        let marked = self.enclave_nodes(node).into_iter().flatten();
        let shared = marked.filter(|other| *other != node && self.is_ambiguous(other));
        shared.cloned().collect()
    }

    /// Returns the robot's node as which the process of `node` runs in a servant; `node` itself if that is unknown.
    pub fn process_owner<'a>(&'a self, node: &'a str) -> &'a str {
        let mut linked = self.enclaves.keys().filter_map(|mark| linked_node(mark));
        linked.find(|linked| self.is_in_process(linked, node)).unwrap_or(node)
    }

    fn enclave_nodes(&self, node: &str) -> Option<&BTreeSet<String>> {
        let mark = enclave_for(node)?;
        self.enclaves.get(&mark)
    }

    /// Returns true if nodes in several enclaves have this name.
    fn is_ambiguous(&self, node: &str) -> bool {
        let with = self.enclaves.values().filter(|nodes| nodes.contains(node));
        with.take(2).count() > 1
    }

    /// Returns the endpoints of these nodes, merged as if they were one node.
    pub fn merged_endpoints(&self, nodes: &BTreeSet<String>) -> NodeEntities {
        let mut all = NodeEntities::default();
        for ends in nodes.iter().filter_map(|node| self.ends.get(node)) {
            all.merge(ends);
        }
        all
    }
}

/// All endpoints of one node as announced by them: by name, with types that carry no definition.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct NodeEntities {
    /// Topics that the node publishes; with several publishers of a topic, the strongest QoS offered.
    pub publishers: BTreeMap<String, (WireType, QosProfile)>,
    /// Topics that the node subscribes to; with several subscriptions to a topic, the weakest QoS requested.
    pub subscribers: BTreeMap<String, (WireType, QosProfile)>,
    /// Services that the node serves.
    pub services: BTreeMap<String, ServiceType>,
    /// Services that the node has clients for.
    pub clients: BTreeMap<String, ServiceType>,
}

impl NodeEntities {
    /// Merges the endpoints of another node; if the types for a name differ, the first one is kept.
    fn merge(&mut self, other: &NodeEntities) {
        let sides =
            [(&mut self.publishers, &other.publishers, true), (&mut self.subscribers, &other.subscribers, false)];
        for (topics, others, publishes) in sides {
            for (topic, (of, qos)) in others {
                let known = topics.entry(topic.clone());
                let known = known.or_insert_with(|| (of.clone(), *qos));
                known.1 = known.1.merge(*qos, publishes);
            }
        }
        let sides = [(&mut self.services, &other.services), (&mut self.clients, &other.clients)];
        for (services, others) in sides {
            for (service, of) in others {
                services.entry(service.clone()).or_insert_with(|| of.clone());
            }
        }
    }

    /// Returns the names of the endpoints.
    pub fn names(&self) -> NodeNames {
        NodeNames {
            publishes: self.publishers.keys().cloned().collect(),
            subscribes: self.subscribers.keys().cloned().collect(),
            serves: self.services.keys().cloned().collect(),
        }
    }
}

/// Names of the endpoints of a node.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct NodeNames {
    /// Published topics.
    #[serde(rename = "outputs")]
    pub publishes: BTreeSet<String>,
    /// Subscribed topics.
    #[serde(rename = "inputs")]
    pub subscribes: BTreeSet<String>,
    /// Served services.
    #[serde(rename = "services")]
    pub serves: BTreeSet<String>,
}

/// The nodes at both ends of one topic.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TopicNodes {
    /// `package/Type`, in ROS 2 `package/msg/Type`, or `*` while the type is unknown.
    pub type_name: String,
    /// Names of publishing nodes.
    pub publishers: Vec<String>,
    /// Names of subscribing nodes.
    pub subscribers: Vec<String>,
}

/// The nodes at both ends of one action.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ActionNodes {
    /// `package/Name`, in ROS 2 `package/action/Name`, or `*` while the type is unknown.
    pub type_name: String,
    /// Names of nodes that serve the action.
    pub servers: Vec<String>,
    /// Names of nodes that may send goals.
    pub clients: Vec<String>,
    /// Topics that the action consists of, where actions consist of topics (ROS 1).
    pub topics: Vec<String>,
}

/// Nodes that used a parameter.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ParameterUse {
    /// Nodes that read it (`getParam`, `hasParam`, `searchParam`, `subscribeParam`).
    pub read_by: Vec<String>,
    /// Nodes that set it.
    pub written_by: Vec<String>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::QosReliability;

    #[test]
    fn nodes_of_one_process_are_known_by_its_enclave_and_seen_as_one() {
        let weak = QosProfile { reliability: QosReliability::BestEffort, ..QosProfile::keep_last(5) };
        let topic = |name: &str, qos| (name.to_owned(), (WireType::any(), qos));
        let set = ServiceType::new("std_srvs/srv/SetBool", "*");
        let ears = NodeEntities {
            publishers: [topic("/log", weak)].into(),
            subscribers: [topic("/scan", QosProfile::keep_last(1))].into(),
            ..NodeEntities::default()
        };
        let mouth = NodeEntities {
            publishers: [topic("/log", QosProfile::keep_last(9).latching(true))].into(),
            subscribers: [topic("/scan", weak)].into(),
            services: [("/mouth/set".to_owned(), set.clone())].into(),
            ..NodeEntities::default()
        };
        let named = |names: &[&str]| names.iter().map(ToString::to_string).collect();
        let mark = enclave_for("/ears").expect("a mark");
        let graph = Graph {
            enclaves: [(mark, named(&["/ears", "/mouth"]))].into(),
            ends: [("/ears".to_owned(), ears), ("/mouth".to_owned(), mouth.clone()), ("/nose".to_owned(), mouth)]
                .into(),
            ..Graph::default()
        };
        let nodes: BTreeSet<String> = graph.process_nodes("/ears");
        assert_eq!(nodes, named(&["/ears", "/mouth"]));
        assert_eq!(graph.process_nodes("/nose"), named(&["/nose"]));
        assert!(graph.is_in_process("/ears", "/mouth"));
        assert!(!graph.is_in_process("/ears", "/nose") && !graph.is_in_process("/mouth", "/ears"));
        let owners = ["/ears", "/mouth", "/nose"].map(|node| graph.process_owner(node));
        assert_eq!(owners, ["/ears", "/ears", "/nose"]);
        let all = graph.merged_endpoints(&nodes);
        // The strongest QoS that is offered, and the weakest that is requested.
        let log = all.publishers["/log"].1;
        assert!(log.is_latching() && log.reliability == QosReliability::Reliable);
        assert_eq!(all.subscribers["/scan"].1.reliability, QosReliability::BestEffort);
        assert_eq!(all.services, [("/mouth/set".to_owned(), set)].into());
    }
    #[test]
    fn a_further_node_whose_name_two_processes_have_is_of_neither() {
        let named = |names: &[&str]| names.iter().map(ToString::to_string).collect();
        let process = |node: &str, nodes: &[&str]| {
            let mark = enclave_for(node).expect("a mark");
            (mark, named(nodes))
        };
        let graph = Graph {
            enclaves: [
                process("/left", &["/left", "/tenor", "/right", "/bass"]),
                process("/right", &["/right", "/tenor"]),
            ]
            .into(),
            ..Graph::default()
        };
        // The first node of a process always belongs to it, even if another process uses its name.
        assert_eq!(graph.process_nodes("/left"), named(&["/bass", "/left"]));
        assert_eq!(graph.process_nodes("/right"), named(&["/right"]));
        assert!(graph.is_in_process("/left", "/bass") && graph.is_in_process("/right", "/right"));
        for (node, other) in [("/left", "/tenor"), ("/right", "/tenor"), ("/left", "/right")] {
            assert!(!graph.is_in_process(node, other), "{node} {other}");
        }
        let shared: BTreeSet<String> = named(&["/right", "/tenor"]);
        assert_eq!(graph.ambiguous_process_nodes("/left"), shared);
        assert_eq!(graph.ambiguous_process_nodes("/right"), named(&["/tenor"]));
    }
}
