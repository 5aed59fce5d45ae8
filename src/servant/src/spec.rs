//! What a servant is to be: image, limits, nodes, grants. Nothing in it is of one host: an engine gets the image's layers,
//! and what grants mean, in its own way.

use std::collections::BTreeMap;

use api::Grants;
use serde::{Deserialize, Serialize};

/// Everything the engine needs to know.
#[derive(Debug, Clone, PartialEq)]
pub struct Spec {
    /// Unique among the engine's servants; `[a-z0-9-]`, at most 48 characters. The container's host name.
    pub id: String,
    /// Digest of the image's manifest, `sha256:…`.
    pub image: String,
    /// Hard limits.
    pub limits: Limits,
    /// Environment of every process; what a granted device adds wins.
    pub environment: BTreeMap<String, String>,
    /// Processes to start, in order, once the container runs.
    pub nodes: Vec<NodeSpec>,
    /// Devices, volumes and hosts by name, beyond the container.
    pub grants: Grants,
    /// Handed as it is to whoever keeps the nodes company (the composed ROS Master): initial parameters and the like.
    pub resident: serde_json::Value,
}

/// Of a number in [`Limits`] (memory, processes, bytes a second) that is changed: none again.
pub const UNLIMITED: u64 = u64::MAX;

/// Hard limits; none means the engine's default, and of a servant that runs: as it is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Limits {
    /// Cores, such as 1.5.
    pub cpus: Option<f64>,
    /// Relative share when cores are scarce, 1..10000, 100 by default (`cpu.weight`).
    pub cpu_weight: Option<u64>,
    /// Bytes of memory, swap not included (`memory.max`; there is no swap). A servant that needs more is killed, whole.
    pub memory: Option<u64>,
    /// Bytes of memory above which it is slowed down and made to give back (`memory.high`; v2 only).
    pub memory_high: Option<u64>,
    /// Processes and threads.
    pub pids: Option<u64>,
    /// Bytes a second read from the disk that holds the layers (`io.max`).
    pub io_read: Option<u64>,
    /// Bytes a second written to it.
    pub io_write: Option<u64>,
    /// On which cores it may run, bit n of word n / 64 for core n (`cpuset.cpus`).
    pub cpuset: Option<[u64; 4]>,
}

impl Limits {
    /// These, with `default` where nothing is said.
    pub fn or(self, default: &Self) -> Self {
        Self {
            cpus: self.cpus.or(default.cpus),
            cpu_weight: self.cpu_weight.or(default.cpu_weight),
            memory: self.memory.or(default.memory),
            memory_high: self.memory_high.or(default.memory_high),
            pids: self.pids.or(default.pids),
            io_read: self.io_read.or(default.io_read),
            io_write: self.io_write.or(default.io_write),
            cpuset: self.cpuset.or(default.cpuset),
        }
    }
}

/// The variable in the environment of a node that says for which run of its starter's it was started; so it is known to later
/// daemons ([`crate::engine::Servant::run`]).
pub const RUN: &str = "CLOUDROID_RUN";

/// One process to run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NodeSpec {
    /// Its name in logs and events, such as `/people_detect`. Unique within the servant.
    pub name: String,
    /// Absolute path of the executable inside, then its arguments.
    pub argv: Vec<String>,
    /// Added to the servant's environment.
    #[serde(default)]
    pub environment: BTreeMap<String, String>,
    /// Working directory inside; `/` when empty.
    #[serde(default)]
    pub directory: String,
    /// Start it again when it ends, whatever its status (roslaunch's `respawn`).
    #[serde(default)]
    pub respawn: bool,
    /// Seconds before that.
    #[serde(default)]
    pub respawn_delay: f64,
    /// When it ends the whole servant ends (roslaunch's `required`).
    #[serde(default)]
    pub required: bool,
}
