//! The interface of a service: everything a robot can see of the package.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

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
    /// Actions (actionlib), by name; their five topics are not repeated in `topics`.
    pub actions: Vec<Action>,
    /// Parameters that a node read or wrote, by name.
    pub parameters: Vec<Parameter>,
    /// Services that nodes of the package call and none of them serves, by name.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub needs: Vec<Need>,
    /// Definition texts by `package/msg/Type`, `package/srv/Type`, `package/action/Type`:
    /// those used above and all they refer to.
    pub definitions: BTreeMap<String, String>,
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
    /// `package/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// MD5 of the type, lower-case hex, as the node announced it and as the definition gives it. Empty where it is
    /// not known yet, as in a supplement.
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
}

/// A service the package serves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Service {
    /// Absolute name.
    pub name: String,
    /// `package/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// MD5 of request and response. Empty where it is not known yet.
    #[serde(default)]
    pub md5: String,
    /// The serving node. Empty where it is not known.
    #[serde(default)]
    pub node: String,
}

/// An action the package serves (actionlib: goal, cancel, status, feedback, result).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Action {
    /// Absolute name, without the `/goal` of its topics.
    pub name: String,
    /// `package/Name` of the `.action` file, without `Action`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// The serving node. Empty where it is not known.
    #[serde(default)]
    pub node: String,
}

/// A service that the package looks for on its robot. A lookup tells no type.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Need {
    /// Absolute name.
    pub name: String,
    /// Nodes of the package that looked for it.
    #[serde(default)]
    pub nodes: Vec<String>,
}

/// A parameter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Parameter {
    /// Absolute name.
    pub name: String,
    /// Its value when the interface was found, as JSON; none where it was only asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub value: Option<serde_json::Value>,
    /// Nodes that asked for it.
    #[serde(default)]
    pub read_by: Vec<String>,
    /// Nodes that wrote it.
    #[serde(default)]
    pub written_by: Vec<String>,
}
