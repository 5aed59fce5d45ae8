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

/// Limits made of two, field by field: each by a function of two options, that of cores to run on by another if one is given.
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
    /// These limits, with `default` where nothing is said.
    pub fn or(self, default: Limits) -> Limits {
        field_by_field!(self, default, Option::or)
    }

    /// Those of `other` where these say something.
    pub fn and(self, other: Limits) -> Limits {
        field_by_field!(self, other, Option::and)
    }

    /// These limits, without those that `other` has, too.
    pub fn without(self, other: Limits) -> Limits {
        fn unlike<T: PartialEq>(one: Option<T>, other: Option<T>) -> Option<T> {
            one.filter(|one| other.as_ref() != Some(one))
        }
        field_by_field!(self, other, unlike)
    }

    /// The smallest limits that are enough for both; the cores that these name, if any, to run on.
    pub fn most(self, other: Limits) -> Limits {
        fn more<T: PartialOrd>(one: Option<T>, other: Option<T>) -> Option<T> {
            match (one, other) {
                (Some(one), Some(other)) => Some(if other > one { other } else { one }),
                (one, other) => one.or(other),
            }
        }
        field_by_field!(self, other, more, Option::or)
    }

    /// What is limited: the name of the flag that sets it, and its value as written there.
    pub fn named(&self) -> impl Iterator<Item = (&'static str, String)> {
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
        assert_eq!(merged(few.most(more)), (more.cpus, memory, nine, first));
        assert_eq!(merged(few.without(few)), (None, None, None, None));
        let named: Vec<_> = few.or(more).named().map(|(name, _)| name).collect();
        assert_eq!(named, ["cpus", "cpuset", "memory", "pids"]);
    }
}
