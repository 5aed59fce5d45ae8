//! `revision.toml` beside `stub.toml`: what the server made the stub of.

use std::collections::BTreeMap;
use std::path::Path;

use ros::bus::RosVersion;
use serde::Deserialize;

/// The file, as far as it matters on the robot. Everything is absent in a stub that was put together by hand.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub struct Revision {
    /// The service's ROS: 1 or 2; 1 where absent, as before there were stubs of the other.
    pub ros: Option<u8>,
    /// The service's revision.
    pub revision: Option<u64>,
    /// Digest of its image.
    pub image: String,
    /// Executables that run in the cloud.
    pub outsourced: Vec<String>,
    /// Names that programs give their nodes where nobody else does, by executable.
    pub names: BTreeMap<String, String>,
    /// What holds where the robot says nothing.
    pub defaults: Defaults,
    /// Which inputs are answered by which outputs, as the push has decided.
    pub requests: Vec<Answered>,
}

/// An input of a node and the outputs that answer it.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
#[serde(default)]
pub struct Answered {
    /// Absolute name of the node at the push; empty where it was not known.
    pub node: String,
    /// Its executable, where it is known.
    pub program: Option<String>,
    /// `INPUT -> OUTPUT, OUTPUT by stamp`, by absolute names at the push, as they were without remaps.
    pub request: String,
}

/// What the service's deployer says of response times, in seconds; both or neither.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(default)]
pub struct Defaults {
    /// T_desire.
    pub desire: Option<f64>,
    /// T_max.
    pub max: Option<f64>,
}

impl Revision {
    /// That of the stub with this share directory.
    pub fn read(share: &Path) -> Self {
        let text = std::fs::read_to_string(share.join("revision.toml")).unwrap_or_default();
        toml::from_str(&text).unwrap_or_default()
    }

    /// The service's ROS, which is the robot's.
    pub fn ros(&self) -> RosVersion {
        match self.ros {
            Some(2) => RosVersion::Two,
            _ => RosVersion::One,
        }
    }
}
