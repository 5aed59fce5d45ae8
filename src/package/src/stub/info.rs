//! Description of the service that a stub is for, and the terms and files that both ROS versions share.

use std::collections::{BTreeMap, BTreeSet};

use ros::bus::RosVersion;

use super::package_files::Content;
use crate::interface::Interface;

/// Address of the portal for robots.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Portal {
    /// URL, such as `wss://server:9090`.
    pub address: String,
    /// Fingerprint of the certificate, if it is not issued by a CA.
    pub fingerprint: Option<String>,
}

/// Properties of the service that a stub is built for.
#[derive(Debug, Clone)]
pub struct StubInfo<'a> {
    /// ROS version of the robot.
    pub ros: RosVersion,
    /// ROS version of the service.
    pub service_ros: RosVersion,
    /// Name of the service.
    pub service: &'a str,
    /// ROS package.
    pub package: &'a str,
    /// Revision of the service.
    pub revision: u64,
    /// Digest of the image.
    pub image: &'a str,
    /// Address of the portal.
    pub portal: &'a Portal,
    /// Architecture of the robot's program, in the terms of `uname -m`.
    pub architecture: &'a str,
    /// Executables that run in the cloud.
    pub outsourced: &'a BTreeSet<String>,
    /// Names that programs give their own nodes, by executable, as far as known.
    pub names: &'a BTreeMap<String, String>,
    /// Interface of the service, with types of the robot's ROS.
    pub interface: &'a Interface,
    /// True if answers depend on earlier requests, as declared by the deployer.
    pub stateful: bool,
    /// Request pairs of the nodes.
    pub requests: &'a [ProgramRequest],
    /// Default T_desire and T_max in seconds, as set by the deployer.
    pub times: Option<(f64, f64)>,
}

impl StubInfo<'_> {
    /// Returns whether robot and service have different versions of ROS.
    pub fn is_for_other_ros(&self) -> bool {
        self.ros != self.service_ros
    }
}

/// Request pair of a node, with topics as its program names them.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct ProgramRequest {
    /// Absolute name of the node at the push; topics below or beside it are so on a robot as well.
    pub node: String,
    /// Executable of the node, if known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub program: Option<String>,
    /// Absolute names of the topics before remapping.
    pub request: qos::TopicPair,
}

/// Files of a stub, by path in the install space.
pub type Files = BTreeMap<String, Content>;

/// Terms in the generated texts that differ between the ROS versions.
pub(super) struct RosTerms {
    /// Command that starts a node.
    pub(super) run: &'static str,
    /// Reason why the overlay's setup file is sourced last.
    pub(super) order: &'static str,
    /// Description of what cannot be loaded on the robot.
    pub(super) plugins: &'static str,
    /// Places besides `stub.toml` where a robot may give a setting.
    pub(super) settings: &'static str,
}

/// Returns a file with this text.
pub(super) fn text_file(text: &str) -> Content {
    Content::File { bytes: text.as_bytes().to_vec(), executable: false }
}

/// Returns the path of `pkg/msg/Type` in the install space, if it is of this package.
pub(super) fn definition_path(package: &str, key: &str) -> Option<String> {
    let (kind, name) = key.strip_prefix(package)?.strip_prefix('/')?.split_once('/')?;
    let known = matches!(kind, "msg" | "srv" | "action") && crate::names::is_type(name);
    known.then(|| format!("share/{package}/{kind}/{name}.{kind}"))
}
