//! Limits that were asked for and are not in force, with the reasons.

use super::EnforcedLimits;
use crate::spec::{ResourceLimits, UNLIMITED};

/// Returns the names of the limits that were asked for and are not in force. Memory may be rounded down to a page,
/// cores to a thousandth of one.
pub fn missing_limits(asked: &ResourceLimits, got: &ResourceLimits) -> Vec<&'static str> {
    let number = |value: Option<u64>| value.map(|value| value as f64);
    // If a limit is to be removed, no limit in force is right.
    let lifted = |asked, got: Option<u64>| number(got.or(lifted_limit(asked)));
    let numbers = [
        ("cpus", asked.cpus, got.cpus, 0.001),
        (
            "cpu_weight",
            number(asked.cpu_weight),
            number(got.cpu_weight),
            1.0,
        ),
    ];
    let amounts = [
        // Memory is counted in pages.
        ("memory", asked.memory, got.memory, 65536.0),
        ("memory_high", asked.memory_high, got.memory_high, 65536.0),
        ("pids", asked.pids, got.pids, 0.0),
        ("io_read", asked.io_read, got.io_read, 0.0),
        ("io_write", asked.io_write, got.io_write, 0.0),
    ];
    let amounts = amounts
        .map(|(name, asked, got, tolerance)| (name, number(asked), lifted(asked, got), tolerance));
    let is_missing = |asked: Option<f64>, got: Option<f64>, tolerance: f64| match (asked, got) {
        (Some(asked), Some(got)) => (asked - got).abs() > tolerance,
        (asked, _) => asked.is_some(),
    };
    let mut missing: Vec<&str> = numbers
        .into_iter()
        .chain(amounts)
        .filter(|(_, asked, got, tolerance)| is_missing(*asked, *got, *tolerance))
        .map(|(name, ..)| name)
        .collect();
    if asked.cpuset.is_some() && asked.cpuset != got.cpuset {
        missing.push("cpuset");
    }
    missing
}

fn lifted_limit(asked: Option<u64>) -> Option<u64> {
    asked.filter(|limit| *limit == UNLIMITED)
}

impl EnforcedLimits {
    /// Returns the limits that were asked for and are not in force, each with the reason.
    pub fn unmet_limits(&self, asked: &ResourceLimits) -> Vec<String> {
        let why = |name| match (self.cgroup_version, name) {
            (0, _) => "no cgroup controller can be used here",
            (1, "memory_high") => {
                "cgroup v1 has no memory.high; its memory.soft_limit_in_bytes does not throttle"
            }
            (1, "cpuset") => {
                "the cpuset controller must be mounted, and cgroup v1 accepts cores only for a servant that was \
                    started with some"
            }
            (1, "io_read" | "io_write") => {
                "cgroup v1 accepts it only for a servant that was started with one and whose layers are on a disk"
            }
            (_, "io_read" | "io_write") => "its layers are not on a disk that can be limited",
            _ => "the kernel rejected it",
        };
        missing_limits(asked, &self.limits)
            .into_iter()
            .map(|name| format!("{name} ({})", why(name)))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_limit_that_is_not_in_force_is_named() {
        let asked = ResourceLimits {
            cpus: Some(1.5),
            memory: Some(100_000_000),
            pids: Some(10),
            ..ResourceLimits::default()
        };
        let got = ResourceLimits {
            memory: Some(99_999_744),
            pids: None,
            ..asked
        };
        assert_eq!(missing_limits(&asked, &got), ["pids"]);
        assert_eq!(missing_limits(&ResourceLimits::default(), &got), [""; 0]);
        let lifted = ResourceLimits {
            pids: Some(UNLIMITED),
            io_read: Some(UNLIMITED),
            ..ResourceLimits::default()
        };
        let still = ResourceLimits {
            io_read: Some(1 << 20),
            ..ResourceLimits::default()
        };
        assert_eq!(missing_limits(&lifted, &still), ["io_read"]);
    }

    #[test]
    fn what_cgroup_v1_does_not_have_is_said() {
        let asked = ResourceLimits {
            memory_high: Some(1 << 26),
            ..ResourceLimits::default()
        };
        let enforced = |cgroup_version| EnforcedLimits {
            cgroup_version,
            ..EnforcedLimits::default()
        };
        let on_v1 = enforced(1).unmet_limits(&asked);
        assert!(
            on_v1[0].starts_with("memory_high (cgroup v1 has no memory.high"),
            "{on_v1:?}"
        );
        assert_eq!(
            enforced(2).unmet_limits(&asked),
            ["memory_high (the kernel rejected it)"]
        );
    }
}
