//! Nodes, and what they have registered.

use std::collections::{BTreeMap, BTreeSet};

use super::{Qos, ServiceType, WireType};

/// What nodes have registered, seen at one moment.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Graph {
    /// Grows by one with every change.
    pub generation: u64,
    /// Topic → its type and the nodes at both ends. Where actions are made of topics (ROS 1), those are among them.
    pub topics: BTreeMap<String, TopicNodes>,
    /// Service → the node that serves it.
    pub services: BTreeMap<String, String>,
    /// Action → its type and the nodes at both ends.
    pub actions: BTreeMap<String, ActionNodes>,
    /// Node → its address: XML-RPC's (ROS 1) or a GUID (ROS 2).
    pub nodes: BTreeMap<String, String>,
    /// Every global parameter that a node asked for or wrote, with the nodes that did.
    pub parameters: BTreeMap<String, ParameterUse>,
    /// Services that nodes looked for when there were none, with those nodes. Told by our own Master, and by ROS 2.
    pub sought: BTreeMap<String, Vec<String>>,
    /// Node → all that it has, with what tools hide, such as the parts of actions. Told by ROS 2 only.
    pub ends: BTreeMap<String, NodeEnds>,
    /// Enclave that processes were put into (`--enclave`) → their nodes, for all but the root. Told by ROS 2 only.
    pub enclaves: BTreeMap<String, BTreeSet<String>>,
}

/// What is there, under whatever name. What tools hide, by a name with a part that begins with `_`, stands in [`Graph::ends`] alone.
impl Graph {
    /// Whether there is a node of this name.
    pub fn has_node(&self, node: &str) -> bool {
        self.nodes.contains_key(node) || self.ends.contains_key(node)
    }

    /// Whether this node publishes the topic.
    pub fn publishes(&self, node: &str, topic: &str) -> bool {
        let shown = self.topics.get(topic);
        let ends = self.ends.get(node);
        shown.is_some_and(|ends| ends.publishers.iter().any(|it| it == node))
            || ends.is_some_and(|ends| ends.publishers.contains_key(topic))
    }

    /// Whether this node subscribes to the topic.
    pub fn subscribes(&self, node: &str, topic: &str) -> bool {
        let shown = self.topics.get(topic);
        let ends = self.ends.get(node);
        shown.is_some_and(|ends| ends.subscribers.iter().any(|it| it == node))
            || ends.is_some_and(|ends| ends.subscribers.contains_key(topic))
    }

    /// Whether some node serves the service.
    pub fn serves(&self, service: &str) -> bool {
        let mut ends = self.ends.values();
        self.services.contains_key(service) || ends.any(|ends| ends.services.contains_key(service))
    }

    /// Whether some node serves the action.
    pub fn serves_action(&self, action: &str) -> bool {
        let shown = self.actions.get(action);
        shown.is_some_and(|ends| !ends.servers.is_empty())
            || self.serves(&crate::ros2::names::part_of_action(action, "send_goal"))
    }

    /// The nodes of the process that a servant runs as a robot's node of this name: that one, and in ROS 2 all that are in the enclave by
    /// which the process is marked. Those that share their name with one of another process are not among them: what nodes have is known by their names.
    pub fn of_process(&self, node: &str) -> BTreeSet<String> {
        let marked = self.marked(node).into_iter().flatten();
        let own = marked.filter(|other| *other == node || !self.is_shared(other));
        own.cloned().chain([node.to_owned()]).collect()
    }

    /// Whether a node is one of that process.
    pub fn is_of_process(&self, node: &str, other: &str) -> bool {
        let marked = || self.marked(node);
        node == other
            || marked().is_some_and(|nodes| nodes.contains(other) && !self.is_shared(other))
    }

    /// Further nodes of that process which are not taken for its own, since another process has one of the same name.
    pub fn shared_of_process(&self, node: &str) -> BTreeSet<String> {
        let marked = self.marked(node).into_iter().flatten();
        let shared = marked.filter(|other| *other != node && self.is_shared(other));
        shared.cloned().collect()
    }

    fn marked(&self, node: &str) -> Option<&BTreeSet<String>> {
        let mark = crate::ros2::process::enclave_of(node)?;
        self.enclaves.get(&mark)
    }

    /// Whether nodes of several enclaves have this name.
    fn is_shared(&self, node: &str) -> bool {
        let with = self.enclaves.values().filter(|nodes| nodes.contains(node));
        with.take(2).count() > 1
    }

    /// What these nodes have, as if they were one.
    pub fn ends_of(&self, nodes: &BTreeSet<String>) -> NodeEnds {
        let mut all = NodeEnds::default();
        for ends in nodes.iter().filter_map(|node| self.ends.get(node)) {
            all.join(ends);
        }
        all
    }
}

/// All that one node has, as its ends tell it: by name, with types that have no definition.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct NodeEnds {
    /// Topics that it publishes. Where it does so several times, the most that it offers.
    pub publishers: BTreeMap<String, (WireType, Qos)>,
    /// Topics that it subscribes to. Where it does so several times, the least that it asks for.
    pub subscribers: BTreeMap<String, (WireType, Qos)>,
    /// Services that it serves.
    pub services: BTreeMap<String, ServiceType>,
    /// Services that it may call.
    pub clients: BTreeMap<String, ServiceType>,
}

impl NodeEnds {
    /// With those of another; of several types of one name the first stays.
    fn join(&mut self, other: &NodeEnds) {
        let sides = [
            (&mut self.publishers, &other.publishers, true),
            (&mut self.subscribers, &other.subscribers, false),
        ];
        for (topics, others, publishes) in sides {
            for (topic, (of, qos)) in others {
                let known = topics.entry(topic.clone());
                let known = known.or_insert_with(|| (of.clone(), *qos));
                known.1 = crate::ros2::joined(known.1, *qos, publishes);
            }
        }
        let sides = [
            (&mut self.services, &other.services),
            (&mut self.clients, &other.clients),
        ];
        for (services, others) in sides {
            for (service, of) in others {
                services
                    .entry(service.clone())
                    .or_insert_with(|| of.clone());
            }
        }
    }

    /// By name.
    pub fn names(&self) -> NodeNames {
        NodeNames {
            publishes: self.publishers.keys().cloned().collect(),
            subscribes: self.subscribers.keys().cloned().collect(),
            serves: self.services.keys().cloned().collect(),
        }
    }
}

/// What a node has, by name.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct NodeNames {
    /// Topics.
    pub publishes: BTreeSet<String>,
    /// Topics.
    pub subscribes: BTreeSet<String>,
    /// Services.
    pub serves: BTreeSet<String>,
}

/// The ends of one topic.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TopicNodes {
    /// `package/Type`, of ROS 2 `package/msg/Type`, or `*` where nobody has said yet.
    pub type_name: String,
    /// Names of publishing nodes.
    pub publishers: Vec<String>,
    /// Names of subscribing nodes.
    pub subscribers: Vec<String>,
}

/// The ends of one action.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ActionNodes {
    /// `package/Name`, of ROS 2 `package/action/Name`, or `*` where nobody has said yet.
    pub type_name: String,
    /// Names of nodes that serve it.
    pub servers: Vec<String>,
    /// Names of nodes that may send goals.
    pub clients: Vec<String>,
    /// Topics that it is made of, in a ROS that makes it of topics (ROS 1).
    pub topics: Vec<String>,
}

/// Who touched a parameter.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ParameterUse {
    /// Nodes that asked for it (`getParam`, `hasParam`, `searchParam`, `subscribeParam`).
    pub read_by: Vec<String>,
    /// Nodes that set it.
    pub written_by: Vec<String>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::Reliability;

    #[test]
    fn nodes_of_one_process_are_known_by_its_enclave_and_seen_as_one() {
        let weak = Qos {
            reliability: Reliability::BestEffort,
            ..Qos::keep_last(5)
        };
        let topic = |name: &str, qos| (name.to_owned(), (WireType::any(), qos));
        let set = ServiceType::new("std_srvs/srv/SetBool", "*");
        let ears = NodeEnds {
            publishers: [topic("/log", weak)].into(),
            subscribers: [topic("/scan", Qos::keep_last(1))].into(),
            ..NodeEnds::default()
        };
        let mouth = NodeEnds {
            publishers: [topic("/log", Qos::keep_last(9).latching(true))].into(),
            subscribers: [topic("/scan", weak)].into(),
            services: [("/mouth/set".to_owned(), set.clone())].into(),
            ..NodeEnds::default()
        };
        let named = |names: &[&str]| names.iter().map(ToString::to_string).collect();
        let mark = crate::ros2::process::enclave_of("/ears").expect("a mark");
        let graph = Graph {
            enclaves: [(mark, named(&["/ears", "/mouth"]))].into(),
            ends: [
                ("/ears".to_owned(), ears),
                ("/mouth".to_owned(), mouth.clone()),
                ("/nose".to_owned(), mouth),
            ]
            .into(),
            ..Graph::default()
        };
        let nodes: BTreeSet<String> = graph.of_process("/ears");
        assert_eq!(nodes, named(&["/ears", "/mouth"]));
        assert_eq!(graph.of_process("/nose"), named(&["/nose"]));
        assert!(graph.is_of_process("/ears", "/mouth"));
        assert!(!graph.is_of_process("/ears", "/nose") && !graph.is_of_process("/mouth", "/ears"));
        let all = graph.ends_of(&nodes);
        // The most that is offered, and the least that is asked for.
        let log = all.publishers["/log"].1;
        assert!(log.is_latching() && log.reliability == Reliability::Reliable);
        assert_eq!(
            all.subscribers["/scan"].1.reliability,
            Reliability::BestEffort
        );
        assert_eq!(all.services, [("/mouth/set".to_owned(), set)].into());
    }
    #[test]
    fn a_further_node_whose_name_two_processes_have_is_of_neither() {
        let named = |names: &[&str]| names.iter().map(ToString::to_string).collect();
        let process = |node: &str, nodes: &[&str]| {
            let mark = crate::ros2::process::enclave_of(node).expect("a mark");
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
        // The first node of a process is its own, whoever has taken its name.
        assert_eq!(graph.of_process("/left"), named(&["/bass", "/left"]));
        assert_eq!(graph.of_process("/right"), named(&["/right"]));
        assert!(graph.is_of_process("/left", "/bass") && graph.is_of_process("/right", "/right"));
        for (node, other) in [
            ("/left", "/tenor"),
            ("/right", "/tenor"),
            ("/left", "/right"),
        ] {
            assert!(!graph.is_of_process(node, other), "{node} {other}");
        }
        let shared: BTreeSet<String> = named(&["/right", "/tenor"]);
        assert_eq!(graph.shared_of_process("/left"), shared);
        assert_eq!(graph.shared_of_process("/right"), named(&["/tenor"]));
    }
}
