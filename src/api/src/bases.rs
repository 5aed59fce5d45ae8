//! Base image definitions and what the server has of each: `GET /api/v1/bases`.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::size::Size;

/// Media type of an exported base, a tar archive of an OCI image layout, and of other archives that become bases.
pub const BASE_ARCHIVE: &str = "application/x-tar";

/// State of the layers of a base.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "kebab-case")]
pub enum BaseState {
    /// The first push that uses it sets it up.
    NotSetUp,
    /// It was set up on this server.
    Ready,
    /// It was imported: from another server, or as an image.
    Imported,
}

/// A base: the operating system and ROS below an image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct BaseSummary {
    /// Name of the definition.
    pub name: String,
    /// One-line description.
    pub summary: String,
    /// ROS version, 1 or 2.
    pub ros: u8,
    /// ROS distribution, such as `noetic`.
    pub distribution: String,
    /// Operating system and its release, such as `debian bookworm`.
    pub system: String,
    /// State of its layers.
    pub state: BaseState,
    /// True if the toolchain is there, too, so that sources are compiled without setting it up first.
    pub toolchain: bool,
    /// Compressed size of its layers in bytes, without the toolchain; 0 if they are not there.
    pub bytes: Size,
}

/// A base with its contents.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct BaseDetail {
    /// The base.
    #[serde(flatten)]
    pub summary: BaseSummary,
    /// Debian packages that its definition installs, with their dependencies.
    pub includes: Vec<String>,
    /// ROS packages with their versions; empty if the base is not set up. A version may be empty.
    pub ros_packages: BTreeMap<String, String>,
    /// Python packages from wheels with their versions.
    pub python_packages: BTreeMap<String, String>,
    /// Debian packages with their versions; empty if the base is not set up.
    pub debian_packages: BTreeMap<String, String>,
    /// Table of what was found in the image that it was made from; empty for other bases.
    pub findings: Vec<BaseFinding>,
}

/// Result of looking for one subject in an image that became a base.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct BaseFinding {
    /// Subject, such as `ROS` or `compiling`.
    pub subject: String,
    /// Description of what was found; begins with `missing` if it is not there.
    pub found: String,
    /// Consequence for pushes; empty if there is none.
    pub consequence: String,
}
