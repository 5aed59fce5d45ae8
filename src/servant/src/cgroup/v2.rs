//! Control files of cgroup v2 (kernel documentation, admin-guide/cgroup-v2).

use std::fs;

use super::Cgroup;
use super::files::{read_device_field, read_field, read_number};
use crate::engine::Usage;
use crate::host::cgroup_pressure;
use crate::spec::{Limits, Size, UNLIMITED};

/// Scheduling period in microseconds; the kernel's default.
const PERIOD: f64 = 100_000.0;

pub(super) fn set(cgroup: &Cgroup, limits: &Limits) {
    // The caller reads back whether a write took effect.
    let write =
        |controller, name, value: String| cgroup.control_file(controller, name).map(|file| fs::write(file, value));
    if let Some(cpus) = limits.cpus {
        write("cpu", "cpu.max", format!("{} {PERIOD}", (cpus * PERIOD).round().max(1000.0)));
    }
    if let Some(weight) = limits.cpu_weight {
        write("cpu", "cpu.weight", weight.to_string());
    }
    if let Some(memory) = limits.memory {
        write("memory", "memory.max", format_limit(memory.0));
        write("memory", "memory.swap.max", "0".into());
        // A servant is killed as a whole: nodes that were spared would wait for the one that was not.
        write("memory", "memory.oom.group", "1".into());
    }
    if let Some(high) = limits.memory_high {
        write("memory", "memory.high", format_limit(high.0));
    }
    if let Some(pids) = limits.pids {
        write("pids", "pids.max", format_limit(pids));
    }
    if let Some(disk) = &cgroup.disk {
        for (key, limit) in [("rbps", limits.io_read), ("wbps", limits.io_write)] {
            if let Some(limit) = limit {
                let limit = format_limit(limit.0);
                write("io", "io.max", format!("{disk} {key}={limit}"));
            }
        }
    }
    if let Some(cpuset) = &limits.cpuset {
        write("cpuset", "cpuset.cpus", cpuset.to_string());
    }
}

/// Formats a limit, or no limit.
fn format_limit(limit: u64) -> String {
    match limit {
        UNLIMITED => "max".to_owned(),
        limit => limit.to_string(),
    }
}

pub(super) fn limits(cgroup: &Cgroup) -> Limits {
    let number = |controller, name| read_number(&cgroup.control_file(controller, name)?);
    let cpus = cgroup.control_file("cpu", "cpu.max").and_then(|file| {
        let text = fs::read_to_string(file).ok()?;
        let (quota, period) = text.trim().split_once(' ')?;
        Some(quota.parse::<f64>().ok()? / period.parse::<f64>().ok()?)
    });
    let io = |key| {
        let disk = cgroup.disk.as_deref()?;
        read_device_field(&cgroup.control_file("io", "io.max")?, disk, key).map(Size)
    };
    let cpuset =
        cgroup.control_file("cpuset", "cpuset.cpus").and_then(|file| fs::read_to_string(file).ok()?.parse().ok());
    Limits {
        cpus,
        cpu_weight: number("cpu", "cpu.weight"),
        memory: number("memory", "memory.max").map(Size),
        memory_high: number("memory", "memory.high").map(Size),
        pids: number("pids", "pids.max"),
        io_read: io("rbps"),
        io_write: io("wbps"),
        cpuset,
    }
}

/// Reads processor time, memory and pressure.
pub(super) fn usage(cgroup: &Cgroup) -> Usage {
    // These files exist even if the controller is not enabled.
    let plain = |name: &str| Some(cgroup.leaves.first()?.directory.join(name));
    let stat = |field| read_field(&plain("cpu.stat")?, field);
    let memory = cgroup.control_file("memory", "memory.current").and_then(|file| read_number(&file));
    Usage {
        cpu_usec: stat("usage_usec").unwrap_or(0),
        throttled_usec: stat("throttled_usec").unwrap_or(0),
        memory: memory.unwrap_or(0),
        reclaimable: cgroup
            .control_file("memory", "memory.stat")
            .and_then(|file| read_field(&file, "inactive_file"))
            .unwrap_or(0),
        pressure: cgroup.leaves.first().and_then(|leaf| cgroup_pressure(&leaf.directory)),
        ..Usage::default()
    }
}
