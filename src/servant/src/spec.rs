//! Description of a servant: image, limits, nodes, grants. Independent of the host: an engine resolves the image's
//! layers and the grants in its own way.

use std::collections::BTreeMap;

use api::Grants;
use serde::{Deserialize, Serialize};

/// Everything the engine needs to know about a servant.
#[derive(Debug, Clone, PartialEq)]
pub struct Spec {
    /// Id, unique among the engine's servants; `[a-z0-9-]`, at most 48 characters. Also the container's host name.
    pub id: String,
    /// Digest of the image's manifest, `sha256:…`.
    pub image: String,
    /// Hard limits.
    pub limits: ResourceLimits,
    /// Environment of every process; variables of granted devices take precedence.
    pub environment: BTreeMap<String, String>,
    /// Processes to start, in order, once the container runs.
    pub nodes: Vec<NodeSpec>,
    /// Devices, volumes and hosts, by name, that are granted beyond the container.
    pub grants: Grants,
    /// Opaque configuration of the shim's resident (the ROS Master): initial parameters and the like.
    pub resident: serde_json::Value,
}

/// Value that removes a numeric limit in a change of [`ResourceLimits`] (memory, processes, bytes per second).
pub const UNLIMITED: u64 = u64::MAX;

/// Hard limits; `None` means the engine's default, and for a running servant no change.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ResourceLimits {
    /// Number of cores, such as 1.5.
    pub cpus: Option<f64>,
    /// Relative share when cores are scarce, 1..10000, default 100 (`cpu.weight`).
    pub cpu_weight: Option<u64>,
    /// Bytes of memory, without swap (`memory.max`; there is no swap). A servant that exceeds it is killed as a whole.
    pub memory: Option<u64>,
    /// Bytes of memory above which it is throttled and its memory reclaimed (`memory.high`; v2 only).
    pub memory_high: Option<u64>,
    /// Number of processes and threads.
    pub pids: Option<u64>,
    /// Bytes per second read from the disk that holds the layers (`io.max`).
    pub io_read: Option<u64>,
    /// Bytes per second written to that disk.
    pub io_write: Option<u64>,
    /// Cores on which it may run, bit n of word n / 64 for core n (`cpuset.cpus`).
    pub cpuset: Option<[u64; 4]>,
}

impl ResourceLimits {
    /// Returns these limits, with those of `default` where there are none.
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
