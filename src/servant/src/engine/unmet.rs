//! Limits that were asked for and are not in force, with the reasons.

use super::EnforcedLimits;
use crate::spec::{Limits, UNLIMITED};

/// Returns the names of the limits that were asked for and are not in force.
pub fn missing_limits(asked: &Limits, got: &Limits) -> Vec<&'static str> {
    let pairs = asked.amounts().into_iter().zip(got.amounts());
    let missing = pairs.filter(|((name, asked), (_, got))| is_missing(name, *asked, *got));
    let mut missing: Vec<&str> = missing.map(|((name, _), _)| name).collect();
    if asked.cpuset.is_some() && asked.cpuset != got.cpuset {
        missing.push("cpuset");
    }
    missing
}

/// Returns whether a limit is not in force. If it is to be removed, no limit in force is right.
fn is_missing(name: &str, asked: Option<f64>, got: Option<f64>) -> bool {
    let lifted = asked.filter(|limit| *limit == UNLIMITED as f64);
    match (asked, got.or(lifted)) {
        (Some(asked), Some(got)) => (asked - got).abs() > rounding(name),
        (asked, _) => asked.is_some(),
    }
}

/// Returns the difference that is rounding by the kernel: to a page of memory, or a thousandth of a core.
fn rounding(name: &str) -> f64 {
    match name {
        "cpus" => 0.001,
        "cpu_weight" => 1.0,
        name if name.starts_with("memory") => 65536.0,
        _ => 0.0,
    }
}

impl EnforcedLimits {
    /// Returns the limits that were asked for and are not in force, each with the reason.
    pub fn unmet_limits(&self, asked: &Limits) -> Vec<String> {
        let why = |name: &str| match (self.cgroup_version, name) {
            (0, _) => "no cgroup controller can be used here",
            (1, "memory_high") => "cgroup v1 has no memory.high; its memory.soft_limit_in_bytes does not throttle",
            (1, "cpuset") => {
                "the cpuset controller must be mounted, and cgroup v1 accepts cores only for a servant that was \
                    started with some"
            }
            (1, name) if name.starts_with("io_") => {
                "cgroup v1 accepts it only for a servant that was started with one and whose layers are on a disk"
            }
            (_, name) if name.starts_with("io_") => "its layers are not on a disk that can be limited",
            _ => "the kernel rejected it",
        };
        missing_limits(asked, &self.limits).into_iter().map(|name| format!("{name} ({})", why(name))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spec::Size;

    #[test]
    fn a_limit_that_is_not_in_force_is_named() {
        let asked = Limits { cpus: Some(1.5), memory: Some(Size(100_000_000)), pids: Some(10), ..Limits::default() };
        let got = Limits { memory: Some(Size(99_999_744)), pids: None, ..asked };
        assert_eq!(missing_limits(&asked, &got), ["pids"]);
        assert_eq!(missing_limits(&Limits::default(), &got), [""; 0]);
        let lifted = Limits { pids: Some(UNLIMITED), io_read: Some(Size(UNLIMITED)), ..Limits::default() };
        let still = Limits { io_read: Some(Size(1 << 20)), ..Limits::default() };
        assert_eq!(missing_limits(&lifted, &still), ["io_read"]);
    }

    #[test]
    fn what_cgroup_v1_does_not_have_is_said() {
        let asked = Limits { memory_high: Some(Size(1 << 26)), ..Limits::default() };
        let enforced = |cgroup_version| EnforcedLimits { cgroup_version, ..EnforcedLimits::default() };
        let on_v1 = enforced(1).unmet_limits(&asked);
        assert!(on_v1[0].starts_with("memory_high (cgroup v1 has no memory.high"), "{on_v1:?}");
        assert_eq!(enforced(2).unmet_limits(&asked), ["memory_high (the kernel rejected it)"]);
    }
}
