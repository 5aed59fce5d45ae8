//! Resource limits and resource usage of servants. Limits are declared once, as fields of the API, flags of the command
//! line and keys of the configuration.

use serde::{Deserialize, Serialize};

use crate::cpuset::CpuSet;
use crate::size::Size;

/// Amount that lifts a limit of a running servant: memory, processes, or bytes per second.
pub const UNLIMITED: u64 = u64::MAX;
/// CPU weight of a servant without one; the kernel's default.
pub const DEFAULT_CPU_WEIGHT: u64 = 100;
/// Least and largest number of cores; servants do not work outside these bounds.
pub(crate) const LEAST_CPUS: f64 = 0.01;
pub(crate) const MOST_CPUS: f64 = 4096.0;
/// Memory and processes without which no node starts.
pub(crate) const LEAST_MEMORY: Size = Size(4 << 20);
const LEAST_PIDS: u64 = 4;

/// Hard resource limits of a servant. An absent limit is the daemon's default, means unlimited (in `enforced`), or is
/// kept (in a change).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "flags", derive(clap::Args))]
#[serde(default, deny_unknown_fields)]
pub struct Limits {
    /// CPU limit in cores, such as 1.5, which is also reserved.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "flags", arg(long, value_name = "N", value_parser = parse_cores))]
    pub cpus: Option<f64>,
    /// CPU weight when cores are scarce, 1 to 10000 (default: 100).
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "flags", arg(long, value_name = "N"))]
    pub cpu_weight: Option<u64>,
    /// CPUs that the servant may run on, such as 0-3,6; on cgroup v1 it can be changed only for a servant that was
    /// started with it.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "flags", arg(long, value_name = "CORES"))]
    pub cpuset: Option<CpuSet>,
    /// Memory limit, without swap, which is also reserved, such as 512M.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "flags", arg(long, value_name = "SIZE"))]
    pub memory: Option<Size>,
    /// Memory above which the servant is slowed down and its memory reclaimed (cgroup v2).
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "flags", arg(long, value_name = "SIZE"))]
    pub memory_high: Option<Size>,
    /// Largest number of processes and threads.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "flags", arg(long, value_name = "N"))]
    pub pids: Option<u64>,
    /// Read rate on the disk with the images in bytes per second, such as 10M.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "flags", arg(long, value_name = "SIZE"))]
    pub io_read: Option<Size>,
    /// Write rate on the disk with the images in bytes per second.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "flags", arg(long, value_name = "SIZE"))]
    pub io_write: Option<Size>,
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

    /// Returns the change that turns these limits of a running servant into those of `after`: equal ones are left out,
    /// since some, such as a cpuset on cgroup v1, cannot be set again. Limits that `after` omits are lifted, to all of
    /// the machine's `cores`; a cpuset stays.
    pub fn changes_to(self, after: Limits, cores: f64) -> Limits {
        after.or(self.and(Limits::unlimited(cores))).without_equal(self)
    }

    /// Returns the limits that lift all others of a running servant, except its cpuset.
    pub fn unlimited(cores: f64) -> Limits {
        Limits {
            cpus: Some(cores),
            cpu_weight: Some(DEFAULT_CPU_WEIGHT),
            memory: Some(Size(UNLIMITED)),
            memory_high: Some(Size(UNLIMITED)),
            pids: Some(UNLIMITED),
            io_read: Some(Size(UNLIMITED)),
            io_write: Some(Size(UNLIMITED)),
            cpuset: None,
        }
    }

    /// Returns the name and amount of each limit that is a number.
    pub fn amounts(&self) -> [(&'static str, Option<f64>); 7] {
        let bytes = |size: Option<Size>| size.map(|size| size.0 as f64);
        let number = |number: Option<u64>| number.map(|number| number as f64);
        [
            ("cpus", self.cpus),
            ("cpu_weight", number(self.cpu_weight)),
            ("memory", bytes(self.memory)),
            ("memory_high", bytes(self.memory_high)),
            ("pids", number(self.pids)),
            ("io_read", bytes(self.io_read)),
            ("io_write", bytes(self.io_write)),
        ]
    }

    /// Refuses limits that no kernel accepts, or with which no node works.
    pub fn check(&self) -> Result<(), UnusableLimits> {
        let refused = |words: String| Err(UnusableLimits::new(words));
        if let Some(cpus) = self.cpus
            && !(LEAST_CPUS..=MOST_CPUS).contains(&cpus)
        {
            return refused(format!("cpus = {cpus} is not between {LEAST_CPUS} and {MOST_CPUS}"));
        }
        if let Some(weight) = self.cpu_weight
            && !(1..=10_000).contains(&weight)
        {
            return refused(format!("cpu_weight = {weight} is not between 1 and 10000"));
        }
        if let Some(memory) = self.memory
            && memory < LEAST_MEMORY
        {
            return refused(format!("memory = {memory} is too little for any node; write at least {LEAST_MEMORY}"));
        }
        if let Some(pids) = self.pids
            && pids < LEAST_PIDS
        {
            return refused(format!("pids = {pids} is too few for any node; write at least {LEAST_PIDS}"));
        }
        if self.cpuset == Some(CpuSet([0; 4])) {
            return refused("cpuset has no core; omit it for all".to_owned());
        }
        // The others have no least amount.
        let zero = self.amounts().into_iter().find(|(_, it)| *it == Some(0.0));
        match zero {
            Some((name, _)) => refused(format!("{name} = 0 would stop the servant; omit it for no limit")),
            None => Ok(()),
        }
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
        all.into_iter().filter_map(|(name, value)| Some((name, value?)))
    }
}

/// The error of limits that no kernel accepts, or that may not be requested.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct UnusableLimits(String);

impl UnusableLimits {
    /// Creates the error: `reason` begins with the limit and says what to write.
    pub fn new(reason: String) -> UnusableLimits {
        UnusableLimits(reason)
    }
}

/// Upper limits on what robots may request.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "flags", derive(clap::Args))]
#[serde(default, deny_unknown_fields)]
pub struct Caps {
    /// Largest number of cores that a robot may request.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "flags", arg(id = "max-cpus", long, value_name = "N", value_parser = parse_cores))]
    pub cpus: Option<f64>,
    /// Largest amount of memory that a robot may request, such as 2G.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "flags", arg(id = "max-memory", long, value_name = "SIZE"))]
    pub memory: Option<Size>,
}

#[cfg(feature = "flags")]
fn parse_cores(text: &str) -> Result<f64, UnusableLimits> {
    let cores = text.parse::<f64>().ok().filter(|cores| cores.is_finite() && *cores > 0.0);
    cores.ok_or_else(|| UnusableLimits::new("write a number of cores such as 1.5".to_owned()))
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
    #[cfg_attr(feature = "schema", schema(required = true))]
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
        let few = Limits { cpus: Some(1.0), pids: Some(9), cpuset: "0".parse().ok(), ..Limits::default() };
        let more = Limits { cpus: Some(2.0), memory: Some(Size(64)), cpuset: "1".parse().ok(), ..Limits::default() };
        let (one, nine, first) = (Some(1.0), Some(9), few.cpuset);
        let merged = |of: Limits| (of.cpus, of.memory, of.pids, of.cpuset);
        let memory = more.memory;
        assert_eq!(merged(few.or(more)), (one, memory, nine, first));
        let shared = (more.cpus, None, None, more.cpuset);
        assert_eq!(merged(few.and(more)), shared);
        assert_eq!(merged(few.combine_max(more)), (more.cpus, memory, nine, first));
        assert_eq!(merged(few.without_equal(few)), (None, None, None, None));
        let named: Vec<_> = few.or(more).flag_values().map(|(name, _)| name).collect();
        assert_eq!(named, ["cpus", "cpuset", "memory", "pids"]);
    }

    #[test]
    fn what_a_change_says_nothing_of_is_none_again() {
        let size = |bytes| Some(Size(bytes));
        let before = Limits {
            cpus: Some(1.0),
            cpu_weight: Some(1000),
            memory: size(64),
            memory_high: size(32),
            pids: Some(9),
            io_read: size(8),
            io_write: size(9),
            cpuset: "0-1".parse().ok(),
        };
        let after = Limits { memory: size(64), io_write: size(7), ..Limits::default() };
        let change = Limits { memory: None, io_write: size(7), ..Limits::unlimited(4.0) };
        assert_eq!(before.changes_to(after, 4.0), change);
        let nothing = Limits::default();
        assert_eq!(before.changes_to(before, 4.0), nothing);
        assert_eq!(nothing.changes_to(nothing, 4.0), nothing);
        assert_eq!(nothing.changes_to(after, 4.0), after);
    }

    #[test]
    fn limits_with_which_nothing_works_are_named() {
        type Change = fn(&mut Limits);
        let wrong: [(Change, &str); 6] = [
            (|limits| limits.cpus = Some(f64::NAN), "cpus = NaN is not"),
            (|limits| limits.cpu_weight = Some(0), "cpu_weight = 0 is not"),
            (|limits| limits.memory = Some(Size(1)), "memory = 1 is too little for any node; write at least 4M"),
            (|limits| limits.pids = Some(3), "pids = 3 is too few"),
            (|limits| limits.io_read = Some(Size(0)), "io_read = 0 would stop"),
            (|limits| limits.cpuset = Some(CpuSet([0; 4])), "cpuset has no core"),
        ];
        for (change, words) in wrong {
            let mut limits = Limits::default();
            assert_eq!(limits.check(), Ok(()));
            change(&mut limits);
            let refused = limits.check().expect_err(words).to_string();
            assert!(refused.starts_with(words), "{refused}");
        }
    }
}
