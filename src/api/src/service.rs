//! Published services and their revisions.

use serde::{Deserialize, Serialize};

use crate::Millis;
use crate::group::{Group, Shared};
use crate::interface::Interface;
use crate::limits::Limits;

/// A service in a list.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct ServiceSummary {
    /// Its name: the path under which robots reach it.
    pub name: String,
    /// Where robots reach it, such as `ws://127.0.0.1:9090/opencv_apps`.
    pub address: String,
    /// The ROS package it was made of.
    pub package: String,
    /// The revision that new servants are started from.
    pub revision: u64,
    /// Digest of that revision's image manifest.
    pub image: String,
    /// When that revision was published.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub published: Millis,
    /// How many topics, ROS services, actions and parameters its interface has.
    pub topics: usize,
    /// ROS services.
    pub services: usize,
    /// Actions.
    pub actions: usize,
    /// Parameters.
    pub parameters: usize,
    /// Servants alive now.
    pub servants: usize,
    /// Limits of a servant.
    pub limits: Limits,
}

/// A service with everything known of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct ServiceDetail {
    /// As in a list.
    #[serde(flatten)]
    pub summary: ServiceSummary,
    /// All revisions, newest first.
    pub revisions: Vec<Revision>,
    /// The current revision's nodes.
    pub nodes: Vec<Node>,
    /// The current revision's interface.
    pub interface: Interface,
    /// Robots share servants of the current revision so; none: each has a servant of its own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shared: Option<Shared>,
    /// Servants that robots share now, of each revision that has any.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub groups: Vec<Group>,
}

/// One push that succeeded.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Revision {
    /// From 1.
    pub number: u64,
    /// Digest of the image manifest.
    pub image: String,
    /// When it was published.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub published: Millis,
    /// What was pushed, in words, such as `--apt opencv_apps`.
    pub source: String,
    /// Whether new servants are started from it.
    pub current: bool,
}

/// A process of a servant.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Node {
    /// Its ROS name.
    pub name: String,
    /// Executable and arguments.
    pub argv: Vec<String>,
}

/// Asks for an earlier revision.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct Rollback {
    /// Which; none: the one before the current.
    pub revision: Option<u64>,
}
