//! Resource limits and resource usage of servants.

use serde::{Deserialize, Serialize};

use crate::cpuset::CpuSet;
use crate::size::Size;

/// Hard resource limits of a servant. An absent limit is the daemon's default, or means unlimited (in `enforced`).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct Limits {
    /// CPU limit in cores, such as 1.5.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpus: Option<f64>,
    /// Relative CPU share under contention, 1 to 10000 (default: 100).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpu_weight: Option<u64>,
    /// Memory limit, without swap.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory: Option<Size>,
    /// Memory above which the servant is throttled and reclaimed, before it is killed at `memory` (cgroup v2 only).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory_high: Option<Size>,
    /// Maximum number of processes and threads.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pids: Option<u64>,
    /// Read bandwidth on the disk with the images, in bytes per second.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub io_read: Option<Size>,
    /// Write bandwidth on the disk with the images, in bytes per second.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub io_write: Option<Size>,
    /// CPUs that the servant may run on, such as `0-3,6`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpuset: Option<CpuSet>,
}

/// Combines two sets of limits field by field with a function of two options; the CPU set with another one, if given.
macro_rules! field_by_field {
    ($one:expr, $other:expr, $of:path) => {
        field_by_field!($one, $other, $of, $of)
    };
    ($one:expr, $other:expr, $of:path, $of_cores:path) => {
        Limits {
            cpus: $of($one.cpus, $other.cpus),
            cpu_weight: $of($one.cpu_weight, $other.cpu_weight),
            memory: $of($one.memory, $other.memory),
            memory_high: $of($one.memory_high, $other.memory_high),
            pids: $of($one.pids, $other.pids),
            io_read: $of($one.io_read, $other.io_read),
            io_write: $of($one.io_write, $other.io_write),
            cpuset: $of_cores($one.cpuset, $other.cpuset),
        }
    };
}

impl Limits {
    /// Returns these limits, with those of `default` where absent.
    pub fn or(self, default: Limits) -> Limits {
        field_by_field!(self, default, Option::or)
    }

    /// Returns the limits of `other` that are also set in `self`.
    pub fn and(self, other: Limits) -> Limits {
        field_by_field!(self, other, Option::and)
    }

    /// Returns these limits without those that are equal in `other`.
    pub fn without_equal(self, other: Limits) -> Limits {
        fn filter_different<T: PartialEq>(one: Option<T>, other: Option<T>) -> Option<T> {
            one.filter(|one| other.as_ref() != Some(one))
        }
        field_by_field!(self, other, filter_different)
    }

    /// Returns the smallest limits that satisfy both; the CPU set of `self` takes precedence.
    pub fn combine_max(self, other: Limits) -> Limits {
        fn larger<T: PartialOrd>(one: Option<T>, other: Option<T>) -> Option<T> {
            match (one, other) {
                (Some(one), Some(other)) => Some(if other > one { other } else { one }),
                (one, other) => one.or(other),
            }
        }
        field_by_field!(self, other, larger, Option::or)
    }

    /// Returns the limits that are set: the name of the corresponding flag and its value.
    pub fn flag_values(&self) -> impl Iterator<Item = (&'static str, String)> {
        fn text(value: Option<impl ToString>) -> Option<String> {
            value.map(|value| value.to_string())
        }
        let all = [
            ("cpus", text(self.cpus)),
            ("cpu-weight", text(self.cpu_weight)),
            ("cpuset", text(self.cpuset)),
            ("memory", text(self.memory)),
            ("memory-high", text(self.memory_high)),
            ("pids", text(self.pids)),
            ("io-read", text(self.io_read)),
            ("io-write", text(self.io_write)),
        ];
        all.into_iter()
            .filter_map(|(name, value)| Some((name, value?)))
    }
}

/// Upper limits on what robots may request.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct Caps {
    /// Maximum CPU in cores.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpus: Option<f64>,
    /// Maximum memory.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory: Option<Size>,
}

impl Caps {
    /// Returns whether there are no caps.
    pub fn is_empty(&self) -> bool {
        *self == Caps::default()
    }
}

/// Resource usage of a servant, as accounted by the kernel.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Usage {
    /// CPU time so far, in microseconds.
    pub cpu_usec: u64,
    /// Current memory usage in bytes.
    pub memory: u64,
    /// Current number of processes and threads.
    pub pids: u64,
    /// Number of processes killed by the OOM killer so far.
    pub oom_kills: u64,
    /// Time throttled by the CPU limit so far, in microseconds.
    #[serde(default)]
    pub throttled_usec: u64,
    /// Resource pressure; absent if the kernel does not report it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pressure: Option<Pressure>,
}

/// Percentage of the last ten seconds in which some thread was stalled (`some avg10` of pressure stall information).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Pressure {
    /// Stalled on CPU.
    pub cpu: f64,
    /// Stalled on memory.
    pub memory: f64,
    /// Stalled on I/O.
    pub io: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_are_merged_field_by_field() {
        let few = Limits {
            cpus: Some(1.0),
            pids: Some(9),
            cpuset: "0".parse().ok(),
            ..Limits::default()
        };
        let more = Limits {
            cpus: Some(2.0),
            memory: Some(Size(64)),
            cpuset: "1".parse().ok(),
            ..Limits::default()
        };
        let (one, nine, first) = (Some(1.0), Some(9), few.cpuset);
        let merged = |of: Limits| (of.cpus, of.memory, of.pids, of.cpuset);
        let memory = more.memory;
        assert_eq!(merged(few.or(more)), (one, memory, nine, first));
        let shared = (more.cpus, None, None, more.cpuset);
        assert_eq!(merged(few.and(more)), shared);
        assert_eq!(
            merged(few.combine_max(more)),
            (more.cpus, memory, nine, first)
        );
        assert_eq!(merged(few.without_equal(few)), (None, None, None, None));
        let named: Vec<_> = few.or(more).flag_values().map(|(name, _)| name).collect();
        assert_eq!(named, ["cpus", "cpuset", "memory", "pids"]);
    }
}
