//! Description of a servant: image, limits, nodes, grants. Independent of the host: an engine resolves the image's
//! layers and the grants in its own way.

use std::collections::BTreeMap;

use api::Grants;
pub use api::limits::UNLIMITED;
pub use api::{Limits, Size};
use serde::{Deserialize, Serialize};

/// Everything the engine needs to know about a servant.
#[derive(Debug, Clone, PartialEq)]
pub struct Spec {
    /// Id, unique among the engine's servants; `[a-z0-9-]`, at most 48 characters. Also the container's host name.
    pub id: String,
    /// Digest of the image's manifest, `sha256:…`.
    pub image: String,
    /// Hard limits; absent ones are the engine's defaults.
    pub limits: Limits,
    /// Environment of every process; variables of granted devices take precedence.
    pub environment: BTreeMap<String, String>,
    /// Processes to start, in order, once the container runs.
    pub nodes: Vec<NodeSpec>,
    /// Devices, volumes and hosts, by name, that are granted beyond the container.
    pub grants: Grants,
    /// Opaque configuration of the shim's resident (the ROS Master): initial parameters and the like.
    pub resident: serde_json::Value,
}

/// Environment variable of a node that names the run for which it was started, as chosen by the caller; so later
/// daemons know it ([`crate::engine::ServantHandle::run_id`]).
pub const RUN: &str = "CLOUDROID_RUN";

/// One process to run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NodeSpec {
    /// Name in logs and events, such as `/people_detect`. Unique within the servant.
    pub name: String,
    /// Absolute path of the executable in the container, then its arguments.
    pub argv: Vec<String>,
    /// Variables added to the servant's environment.
    #[serde(default)]
    pub environment: BTreeMap<String, String>,
    /// Working directory in the container; `/` when empty.
    #[serde(default)]
    pub directory: String,
    /// Restart it when it ends, whatever its status (roslaunch's `respawn`).
    #[serde(default)]
    pub respawn: bool,
    /// Seconds before a restart.
    #[serde(default)]
    pub respawn_delay: f64,
    /// End the whole servant when it ends (roslaunch's `required`).
    #[serde(default)]
    pub required: bool,
}
