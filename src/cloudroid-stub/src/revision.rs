//! The `revision.toml` beside `stub.toml`, which describes the source of the stub.

use std::collections::BTreeMap;
use std::path::Path;

use ros::bus::RosVersion;
use serde::Deserialize;

/// The part of the file that matters on the robot. All fields are absent in a stub that was assembled by hand.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub struct Revision {
    /// ROS version of the robot, 1 or 2 (default: 1, as in stubs made before ROS 2 was supported).
    pub ros: Option<u8>,
    /// ROS version of the service, if it differs from the robot's.
    pub service_ros: Option<u8>,
    /// Revision of the service.
    pub revision: Option<u64>,
    /// Digest of its image.
    pub image: String,
    /// Executables that run in the cloud.
    pub outsourced: Vec<String>,
    /// Default node names by executable, as the programs set them.
    pub names: BTreeMap<String, String>,
    /// Defaults for settings that the robot does not make.
    pub defaults: Defaults,
    /// Inputs and the outputs that answer them, as decided by the push.
    pub requests: Vec<DecidedRequest>,
}

/// An input of a node and the outputs that answer it.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
#[serde(default)]
pub struct DecidedRequest {
    /// Absolute name of the node at the push; empty if unknown.
    pub node: String,
    /// Executable of the node, if known.
    pub program: Option<String>,
    /// `INPUT -> OUTPUT, OUTPUT by stamp`, with absolute names at the push, before remapping.
    pub request: String,
}

/// Response times that the service's deployer has set, in seconds; both or neither.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(default)]
pub struct Defaults {
    /// Default T_desire.
    pub desire: Option<f64>,
    /// Default T_max.
    pub max: Option<f64>,
}

impl Revision {
    /// Reads the revision of the stub with this share directory.
    pub fn read(share: &Path) -> Self {
        let text = std::fs::read_to_string(share.join("revision.toml")).unwrap_or_default();
        toml::from_str(&text).unwrap_or_default()
    }

    /// Returns the ROS version of the robot that the stub is for.
    pub fn ros(&self) -> RosVersion {
        match self.ros {
            Some(2) => RosVersion::Two,
            _ => RosVersion::One,
        }
    }

    /// Returns the ROS version of the service, whose nodes run in the cloud.
    pub fn service_ros(&self) -> RosVersion {
        match self.service_ros {
            Some(1) => RosVersion::One,
            Some(2) => RosVersion::Two,
            _ => self.ros(),
        }
    }
}
