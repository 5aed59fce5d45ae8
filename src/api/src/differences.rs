//! Differences between two revisions of a service.

use serde::{Deserialize, Serialize};

/// Comparison of two revisions.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Differences {
    /// Name of the service.
    pub service: String,
    /// Revision to compare with.
    pub from: u64,
    /// Revision that is compared.
    pub to: u64,
    /// Differences, sorted by part and name; empty if the recorded data are equal.
    pub differences: Vec<Difference>,
}

/// A single difference.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Difference {
    /// Part of the revision that differs.
    pub part: RevisionPart,
    /// Name within the part, such as `/scan` or `cpus`.
    pub name: String,
    /// Value in the old revision; absent if it did not exist there.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub before: Option<String>,
    /// Value in the new revision; absent if it no longer exists.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub after: Option<String>,
}

/// Parts of a revision, in the order in which they are reported.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "kebab-case")]
pub enum RevisionPart {
    /// The ROS package, and the options it was pushed with.
    Push,
    /// A node process.
    Node,
    /// A topic.
    Topic,
    /// A ROS service.
    Service,
    /// A ROS action.
    Action,
    /// A ROS service that the robot must provide.
    Need,
    /// Text of a message, service or action definition.
    Definition,
    /// A parameter set before the nodes start.
    Parameter,
    /// A resource limit of a servant.
    Limit,
    /// Upper limit on what robots may request.
    Cap,
    /// Default SLA of stubs whose robot states none.
    Sla,
    /// A grant beyond the container, such as a device.
    Grant,
    /// Sharing of servants between robots.
    Shared,
    /// An environment variable; its value is not reported.
    Environment,
    /// A ROS package in the image.
    Package,
}
