//! Published services and their revisions.

use serde::{Deserialize, Serialize};

use crate::Millis;
use crate::group::{Group, Shared};
use crate::interface::Interface;
use crate::limits::Limits;

/// Summary of a service.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct ServiceSummary {
    /// Service name; also the path under which robots reach it.
    pub name: String,
    /// Address under which robots reach it, such as `ws://127.0.0.1:9090/opencv_apps`.
    pub address: String,
    /// ROS package that the service was built from.
    pub package: String,
    /// Current revision, which new servants are started from.
    pub revision: u64,
    /// Digest of the current revision's image manifest.
    pub image: String,
    /// Time when the current revision was published.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub published: Millis,
    /// Number of topics in the interface.
    pub topics: usize,
    /// Number of ROS services in the interface.
    pub services: usize,
    /// Number of actions in the interface.
    pub actions: usize,
    /// Number of parameters in the interface.
    pub parameters: usize,
    /// Number of running servants.
    pub servants: usize,
    /// Resource limits of a servant.
    pub limits: Limits,
}

/// A service with all its details.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct ServiceDetail {
    /// Summary of the service.
    #[serde(flatten)]
    pub summary: ServiceSummary,
    /// All revisions, newest first.
    pub revisions: Vec<Revision>,
    /// Nodes of the current revision.
    pub nodes: Vec<Node>,
    /// Interface of the current revision.
    pub interface: Interface,
    /// Sharing of the current revision's servants; absent if each robot has a servant of its own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shared: Option<Shared>,
    /// Groups of shared servants, by revision.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub groups: Vec<Group>,
    /// True if the service has or had a rollout (`GET /api/v1/services/NAME/rollout`).
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub rollout: bool,
}

/// A published revision.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Revision {
    /// Revision number, starting at 1.
    pub number: u64,
    /// Digest of the image manifest.
    pub image: String,
    /// Time of publication.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub published: Millis,
    /// Human-readable description of what was pushed, such as `--apt opencv_apps`.
    pub source: String,
    /// True if this is the current revision.
    pub current: bool,
}

/// A node process of a servant.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Node {
    /// ROS name of the node.
    pub name: String,
    /// Executable and arguments.
    pub argv: Vec<String>,
}

/// Request to roll back to an earlier revision.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct Rollback {
    /// Target revision (default: the one before the current revision).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub revision: Option<u64>,
}
