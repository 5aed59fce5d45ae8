//! What a robot sees of a service: names and types. (The definitions' texts are served apart, at
//! `/api/v1/services/NAME/interface`.)

use serde::{Deserialize, Serialize};

/// Topics, services, actions and parameters.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Interface {
    /// Topics, by name.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub topics: Vec<Topic>,
    /// ROS services, by name.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub services: Vec<Service>,
    /// Actions, by name.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub actions: Vec<Action>,
    /// Parameters, by name.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub parameters: Vec<Parameter>,
    /// ROS services that the package calls and does not serve, by name.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub needs: Vec<Need>,
}

/// A ROS service that a robot should serve.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Need {
    /// Absolute name.
    pub name: String,
    /// Nodes of the package that look for it.
    pub nodes: Vec<String>,
}

/// From the package's point of view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Direction {
    /// The package subscribes: a robot publishes.
    Input,
    /// The package publishes: a robot subscribes.
    Output,
}

/// One end of a topic.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Topic {
    /// Absolute name, such as `/image`.
    pub name: String,
    /// `package/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// MD5 of the type.
    pub md5: String,
    /// Which end the package holds.
    pub direction: Direction,
    /// Newcomers get the last message.
    pub latched: bool,
    /// Registered only while an output is subscribed to.
    pub lazy: bool,
}

/// A ROS service.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema), schema(as = RosService))]
pub struct Service {
    /// Absolute name.
    pub name: String,
    /// `package/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// The serving node.
    pub node: String,
}

/// An action.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Action {
    /// Absolute name.
    pub name: String,
    /// `package/Name`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// The serving node.
    pub node: String,
}

/// A parameter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Parameter {
    /// Absolute name.
    pub name: String,
    /// Its value when the interface was found.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub value: Option<serde_json::Value>,
}
