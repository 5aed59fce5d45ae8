//! The interface of a service: everything a robot can see of the package.

use std::collections::BTreeMap;

use serde::de::IgnoredAny;
use serde::{Deserialize, Deserializer, Serialize};

use crate::requests::Request;

mod descriptor;
mod qos;

pub use descriptor::{Descriptor, Range};
pub use qos::{Durability, Liveliness, Qos, Reliability};

/// Topics, services, actions and parameters with their definitions.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Interface {
    /// Names of services and actions that nodes register only once they have been given what they wait for, such as
    /// transforms or a map. (Topics have [`Topic::lazy`].)
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub late: Vec<String>,
    /// Topics, by name.
    pub topics: Vec<Topic>,
    /// Services, by name.
    pub services: Vec<Service>,
    /// Actions, by name; topics and services that they are made of are not repeated in `topics` and `services`.
    pub actions: Vec<Action>,
    /// Parameters that a node read or wrote, or has of its own (ROS 2), by name.
    pub parameters: Vec<Parameter>,
    /// Services that nodes of the package call and none of them serves, by name; of ROS 2 actions, too.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub needs: Vec<Need>,
    /// Nodes that have a lifecycle (ROS 2), by name; the services of it are not repeated in `services`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub lifecycle: Vec<String>,
    /// Which inputs are answered by which outputs, as the push has decided; none in what was recorded before pushes did
    /// ([`Interface::decided_requests`]).
    #[serde(
        skip_serializing_if = "Option::is_none",
        deserialize_with = "read_requests"
    )]
    pub requests: Option<Vec<Request>>,
    /// Definition texts by `package/msg/Type`, `package/srv/Type`, `package/action/Type`:
    /// those used above and all they refer to.
    pub definitions: BTreeMap<String, String>,
}

/// Reads decided requests. Where one of them cannot be read there are none, and they are decided anew.
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

/// From the package's point of view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Direction {
    /// The package subscribes.
    Input,
    /// The package publishes.
    Output,
}

/// One end of a topic.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Topic {
    /// Absolute name, such as `/image`.
    pub name: String,
    /// `package/Type`, of ROS 2 `package/msg/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// MD5 of the type, lower-case hex, or its type hash (ROS 2), as the node announced it and as the definition gives it.
    /// Empty where it is not known yet, as in a supplement.
    #[serde(default)]
    pub md5: String,
    /// Which end the package holds.
    pub direction: Direction,
    /// Nodes of the package at that end.
    #[serde(default)]
    pub nodes: Vec<String>,
    /// Outputs: newcomers get the last message.
    #[serde(default)]
    pub latched: bool,
    /// Registered only while an output is subscribed to, or once the node has been given what it waits for.
    #[serde(default)]
    pub lazy: bool,
    /// What the package's nodes offer, or ask for, where ends tell it (ROS 2): of several ends, what suits all of them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub qos: Option<Qos>,
}

/// A service the package serves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Service {
    /// Absolute name.
    pub name: String,
    /// `package/Type`, of ROS 2 `package/srv/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// MD5, or type hash, of request and response. Empty where it is not known yet.
    #[serde(default)]
    pub md5: String,
    /// The serving node. Empty where it is not known.
    #[serde(default)]
    pub node: String,
}

/// An action the package serves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Action {
    /// Absolute name, without the `/goal` of its topics.
    pub name: String,
    /// `package/Name` of the `.action` file, without `Action`; of ROS 2 `package/action/Name`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// The serving node. Empty where it is not known.
    #[serde(default)]
    pub node: String,
}

/// A service, or of ROS 2 an action, that the package looks for on its robot. A lookup tells no type.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Need {
    /// Absolute name.
    pub name: String,
    /// Nodes of the package that looked for it.
    #[serde(default)]
    pub nodes: Vec<String>,
}

/// A parameter.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Parameter {
    /// Absolute name; of a node's own parameter the node's name, a slash, and what the node calls it: `/see/camera.rate`.
    pub name: String,
    /// The node whose own it is (ROS 2); empty where nodes share their parameters.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub node: String,
    /// Its value when the interface was found, as JSON; none where it was only asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub value: Option<serde_json::Value>,
    /// Nodes that asked for it.
    #[serde(default)]
    pub read_by: Vec<String>,
    /// Nodes that wrote it.
    #[serde(default)]
    pub written_by: Vec<String>,
    /// What its node says of it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub descriptor: Option<Descriptor>,
}

impl Parameter {
    /// What its node calls it; none where nodes share it.
    pub fn own_name(&self) -> Option<&str> {
        let below = self.name.strip_prefix(&self.node)?.strip_prefix('/')?;
        (!self.node.is_empty()).then_some(below)
    }
}
