//! What a servant may use, and what it uses.

use serde::{Deserialize, Serialize};

use crate::cpuset::CpuSet;
use crate::size::Size;

/// Hard limits of one servant; none: the daemon's default, or not limited (in `enforced`).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct Limits {
    /// Cores, such as 1.5.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpus: Option<f64>,
    /// Relative share when cores are scarce, 1 to 10000 (100 by default).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpu_weight: Option<u64>,
    /// Memory, swap not included.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory: Option<Size>,
    /// Memory above which it is slowed down and made to give back, before it is killed at `memory` (cgroup v2 only).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory_high: Option<Size>,
    /// Processes and threads.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pids: Option<u64>,
    /// Bytes a second read from the disk that holds the images.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub io_read: Option<Size>,
    /// Bytes a second written to it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub io_write: Option<Size>,
    /// The cores it may run on, such as `0-3,6`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpuset: Option<CpuSet>,
}

impl Limits {
    /// These limits, with `default` where nothing is said.
    pub fn or(self, default: Limits) -> Limits {
        Limits {
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

/// The most that a robot may ask for.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct Caps {
    /// Cores.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpus: Option<f64>,
    /// Memory.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory: Option<Size>,
}

impl Caps {
    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        *self == Caps::default()
    }
}

/// What a servant has used, as the kernel counts it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Usage {
    /// Microseconds of processor time so far.
    pub cpu_usec: u64,
    /// Memory now.
    pub memory: u64,
    /// Processes and threads now.
    pub pids: u64,
    /// Processes killed for want of memory so far.
    pub oom_kills: u64,
    /// Microseconds so far in which it wanted to run and had used its cores up.
    #[serde(default)]
    pub throttled_usec: u64,
    /// How much it waits for what others use; none where the kernel does not tell.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pressure: Option<Pressure>,
}

/// Percent of the last ten seconds in which some thread waited (`some avg10` of pressure stall information).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Pressure {
    /// For a core.
    pub cpu: f64,
    /// For memory.
    pub memory: f64,
    /// For a disk.
    pub io: f64,
}
