//! The interface that the local original is expected to have.

use std::collections::{BTreeMap, BTreeSet};

use ros::bus::{QosProfile, WireType};

/// Known interface of the node. The original is ready when it subscribes to its requests and has registered the rest,
/// or has had the time to. Inputs that it may wait for before it subscribes to requests are fed to it from its start
/// ([`Keeper`](super::Keeper)).
#[derive(Debug, Clone, Default)]
pub struct ExpectedInterface {
    /// Topics that it subscribes to.
    pub inputs: BTreeMap<String, WireType>,
    /// Quality of service that it requests for inputs, if known (ROS 2).
    pub asked: BTreeMap<String, QosProfile>,
    /// Inputs that are requests: the original is not ready before it subscribes to them.
    pub awaited: BTreeSet<String>,
    /// Topics that it publishes.
    pub outputs: Vec<String>,
    /// Services that it offers.
    pub services: Vec<String>,
    /// Names of the above that belong to further nodes of its process. These may differ in each run (a transform
    /// listener has a random name), so only requests among them are waited for, and no longer than for the rest.
    pub of_others: BTreeSet<String>,
}

impl ExpectedInterface {
    /// Returns whether the original is expected to register this name, within the time for registrations.
    pub(super) fn is_expected(&self, name: &str) -> bool {
        self.awaited.contains(name) || !self.of_others.contains(name)
    }

    /// Returns whether the original is not ready before it subscribes to this topic, however long that takes.
    pub(super) fn is_required_input(&self, topic: &str) -> bool {
        self.awaited.contains(topic) && !self.of_others.contains(topic)
    }
}
