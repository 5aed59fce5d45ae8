//! Nodes, and what they have registered.

use std::collections::BTreeMap;

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
    /// Services that nodes looked for when there were none, with those nodes. Told by our own Master only.
    pub sought: BTreeMap<String, Vec<String>>,
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
