//! What a servant may use, and what it uses.

use serde::{Deserialize, Serialize};

use crate::size::Size;

/// Hard limits of one servant; none: the daemon's default, or not limited (in `enforced`).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
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
    /// Processes and threads.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pids: Option<u64>,
}

impl Limits {
    /// These limits, with `default` where nothing is said.
    pub fn or(self, default: Limits) -> Limits {
        Limits {
            cpus: self.cpus.or(default.cpus),
            cpu_weight: self.cpu_weight.or(default.cpu_weight),
            memory: self.memory.or(default.memory),
            pids: self.pids.or(default.pids),
        }
    }
}

/// What a servant has used, as the kernel counts it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Usage {
    /// Microseconds of processor time so far.
    pub cpu_usec: u64,
    /// Memory now.
    pub memory: u64,
    /// Processes and threads now.
    pub pids: u64,
    /// Processes killed for want of memory so far.
    pub oom_kills: u64,
}
