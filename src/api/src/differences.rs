//! What differs between two revisions of a service.

use serde::{Deserialize, Serialize};

/// Two revisions, compared.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Differences {
    /// The service.
    pub service: String,
    /// The revision that is compared with.
    pub from: u64,
    /// The revision that is compared.
    pub to: u64,
    /// What differs, by part and name; empty: nothing that is recorded.
    pub differences: Vec<Difference>,
}

/// One thing that differs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Difference {
    /// Of which part.
    pub part: RevisionPart,
    /// Its name there, such as `/scan`, or `cpus`.
    pub name: String,
    /// What it was; none: it was not there.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub before: Option<String>,
    /// What it is; none: it is not there any more.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub after: Option<String>,
}

/// Parts of a revision, in the order in which they are told.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "kebab-case")]
pub enum RevisionPart {
    /// The ROS package, and how it was pushed.
    Push,
    /// A process.
    Node,
    /// A topic.
    Topic,
    /// A ROS service.
    Service,
    /// An action.
    Action,
    /// A ROS service that a robot should serve.
    Need,
    /// The text of a message, service or action definition.
    Definition,
    /// A parameter that is set before nodes start.
    Parameter,
    /// A limit of a servant.
    Limit,
    /// What a robot may ask for at most.
    Cap,
    /// What stubs promise where their robot says nothing.
    Sla,
    /// What was asked for beyond a container.
    Grant,
    /// How robots share its servants.
    Shared,
    /// A variable of the environment; its value is not told.
    Environment,
    /// A ROS package in the image.
    Package,
}
