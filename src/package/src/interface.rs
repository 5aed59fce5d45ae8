//! The interface of a service: everything that a robot can see of the package.

use std::collections::BTreeMap;

use serde::de::IgnoredAny;
use serde::{Deserialize, Deserializer, Serialize};

use crate::request::Request;

mod descriptor;
pub mod qos;

pub use descriptor::{Descriptor, Range};
pub use qos::{Durability, Liveliness, Qos, Reliability};

/// Topics, services, actions and parameters with their definitions.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Interface {
    /// Names of services and actions that nodes register only once they have received what they wait for, such as
    /// transforms or a map. (For topics see [`Topic::lazy`].)
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub late: Vec<String>,
    /// Topics, sorted by name.
    pub topics: Vec<Topic>,
    /// Services, sorted by name.
    pub services: Vec<Service>,
    /// Actions, sorted by name; their topics and services are not repeated in `topics` and `services`.
    pub actions: Vec<Action>,
    /// Parameters that nodes read, write or own (ROS 2), sorted by name.
    pub parameters: Vec<Parameter>,
    /// Services (in ROS 2 also actions) that nodes of the package use and none of them provides, sorted by name.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub needs: Vec<Need>,
    /// Lifecycle nodes (ROS 2), sorted by name; their lifecycle services are not repeated in `services`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub lifecycle: Vec<String>,
    /// Request pairs, as decided by the push; absent in interfaces recorded by earlier versions
    /// ([`Interface::decided_requests`]).
    #[serde(skip_serializing_if = "Option::is_none", deserialize_with = "read_requests")]
    pub requests: Option<Vec<Request>>,
    /// Definition texts by `package/msg/Type`, `package/srv/Type`, `package/action/Type`: those used above and all that
    /// they refer to.
    pub definitions: BTreeMap<String, String>,
}

/// Deserializes request pairs. If one of them cannot be decoded, returns `None`, so that they are decided again.
fn read_requests<'de, D: Deserializer<'de>>(from: D) -> Result<Option<Vec<Request>>, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Written {
        Request(Request),
        Unreadable(IgnoredAny),
    }
    let written = Option::<Vec<Written>>::deserialize(from)?;
    let read = |one| match one {
        Written::Request(request) => Some(request),
        Written::Unreadable(_) => None,
    };
    Ok(written.and_then(|all| all.into_iter().map(read).collect()))
}

/// Direction from the package's point of view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Direction {
    /// The package subscribes.
    Input,
    /// The package publishes.
    Output,
}

/// A topic of the package.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Topic {
    /// Absolute name, such as `/image`.
    pub name: String,
    /// Type: `package/Type` (ROS 1) or `package/msg/Type` (ROS 2).
    #[serde(rename = "type")]
    pub type_name: String,
    /// MD5 of the type in lower-case hexadecimal (ROS 1) or its type hash (ROS 2), as announced by the node and as
    /// given by the definition. Empty if not known yet, as in a supplement.
    #[serde(default)]
    pub md5: String,
    /// Direction from the package's point of view.
    pub direction: Direction,
    /// Nodes of the package that publish or subscribe to the topic.
    #[serde(default)]
    pub nodes: Vec<String>,
    /// True for an output whose new subscribers get the last message.
    #[serde(default)]
    pub latched: bool,
    /// True if registered only while an output has subscribers, or once the node has received what it waits for.
    #[serde(default)]
    pub lazy: bool,
    /// QoS offered or requested by the package's nodes, if known (ROS 2); for several endpoints, the QoS that is
    /// compatible with all of them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub qos: Option<Qos>,
}

/// A service provided by the package.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Service {
    /// Absolute name.
    pub name: String,
    /// Type: `package/Type` (ROS 1) or `package/srv/Type` (ROS 2).
    #[serde(rename = "type")]
    pub type_name: String,
    /// MD5 or type hash of request and response. Empty if not known yet.
    #[serde(default)]
    pub md5: String,
    /// Node that provides the service. Empty if unknown.
    #[serde(default)]
    pub node: String,
}

/// An action provided by the package.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Action {
    /// Absolute name, without the `/goal` of its topics.
    pub name: String,
    /// Type: `package/Name` of the `.action` file, without `Action` (ROS 1), or `package/action/Name` (ROS 2).
    #[serde(rename = "type")]
    pub type_name: String,
    /// Node that provides the action. Empty if unknown.
    #[serde(default)]
    pub node: String,
}

/// A service (in ROS 2 also an action) that the package looks up on its robot. A lookup does not reveal the type.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Need {
    /// Absolute name.
    pub name: String,
    /// Nodes of the package that look it up.
    #[serde(default)]
    pub nodes: Vec<String>,
}

/// A parameter.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Parameter {
    /// Absolute name. For a node's own parameter: the node's name, a slash, and the parameter's name in the node, as in
    /// `/see/camera.rate`.
    pub name: String,
    /// Node that owns the parameter (ROS 2); empty if nodes share their parameters.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub node: String,
    /// Value when the interface was recorded, as JSON; absent if the parameter was only read.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub value: Option<serde_json::Value>,
    /// Nodes that read it.
    #[serde(default)]
    pub read_by: Vec<String>,
    /// Nodes that wrote it.
    #[serde(default)]
    pub written_by: Vec<String>,
    /// Descriptor given by the node.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub descriptor: Option<Descriptor>,
}

impl Parameter {
    /// Returns the parameter's name in its node; `None` if nodes share it.
    pub fn own_name(&self) -> Option<&str> {
        let below = self.name.strip_prefix(&self.node)?.strip_prefix('/')?;
        (!self.node.is_empty()).then_some(below)
    }
}
