//! Limits that were asked for and are not in force, and why.

use super::Enforced;
use crate::spec::{Limits, UNLIMITED};

/// Which of the limits asked for are not in force. Memory may be in force rounded down to a page, cores to a
/// thousandth of one.
pub fn missing(asked: &Limits, got: &Limits) -> Vec<&'static str> {
    let number = |value: Option<u64>| value.map(|value| value as f64);
    // Where it is to be none again, none is in force.
    let lifted = |asked, got: Option<u64>| number(got.or(none(asked)));
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
        // Memory comes in pages.
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

fn none(asked: Option<u64>) -> Option<u64> {
    asked.filter(|limit| *limit == UNLIMITED)
}

impl Enforced {
    /// Which of the limits asked for are not in force, each with the reason.
    pub fn unmet(&self, asked: &Limits) -> Vec<String> {
        let why = |name| match (self.cgroup_version, name) {
            (0, _) => "no cgroup controller can be used here",
            (1, "memory_high") => {
                "cgroup v1 has no memory.high; its memory.soft_limit_in_bytes slows nobody down"
            }
            (1, "cpuset") => {
                "the cpuset controller must be mounted, and cgroup v1 takes cores only of a servant that was given some at \
             its start"
            }
            (1, "io_read" | "io_write") => {
                "cgroup v1 takes it only of a servant that was given one at its start and whose layers lie on a disk"
            }
            (_, "io_read" | "io_write") => "its layers lie on no disk that can be limited",
            _ => "the kernel did not take it",
        };
        missing(asked, &self.limits)
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
        let asked = Limits {
            cpus: Some(1.5),
            memory: Some(100_000_000),
            pids: Some(10),
            ..Limits::default()
        };
        let got = Limits {
            memory: Some(99_999_744),
            pids: None,
            ..asked
        };
        assert_eq!(missing(&asked, &got), ["pids"]);
        assert_eq!(missing(&Limits::default(), &got), [""; 0]);
        let lifted = Limits {
            pids: Some(UNLIMITED),
            io_read: Some(UNLIMITED),
            ..Limits::default()
        };
        let still = Limits {
            io_read: Some(1 << 20),
            ..Limits::default()
        };
        assert_eq!(missing(&lifted, &still), ["io_read"]);
    }

    #[test]
    fn what_cgroup_v1_does_not_have_is_said() {
        let asked = Limits {
            memory_high: Some(1 << 26),
            ..Limits::default()
        };
        let enforced = |cgroup_version| Enforced {
            cgroup_version,
            ..Enforced::default()
        };
        let on_v1 = enforced(1).unmet(&asked);
        assert!(
            on_v1[0].starts_with("memory_high (cgroup v1 has no memory.high"),
            "{on_v1:?}"
        );
        assert_eq!(
            enforced(2).unmet(&asked),
            ["memory_high (the kernel did not take it)"]
        );
    }
}
