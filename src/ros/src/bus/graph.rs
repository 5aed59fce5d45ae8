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
