//! Control files of cgroup v2 (kernel documentation, admin-guide/cgroup-v2).

use std::fs;

use super::files::{read_field, read_number, read_of_device};
use super::{Cgroup, cores};
use crate::engine::Usage;
use crate::host::pressure_of_cgroup;
use crate::spec::{Limits, UNLIMITED};

/// Microseconds; the kernel's default.
const PERIOD: f64 = 100_000.0;

pub(super) fn set(cgroup: &Cgroup, limits: &Limits) {
    // Whether a write took effect is read back by the caller.
    let write = |controller, name, value: String| {
        cgroup
            .file(controller, name)
            .map(|file| fs::write(file, value))
    };
    if let Some(cpus) = limits.cpus {
        write(
            "cpu",
            "cpu.max",
            format!("{} {PERIOD}", (cpus * PERIOD).round().max(1000.0)),
        );
    }
    if let Some(weight) = limits.cpu_weight {
        write("cpu", "cpu.weight", weight.to_string());
    }
    if let Some(memory) = limits.memory {
        write("memory", "memory.max", number(memory));
        write("memory", "memory.swap.max", "0".into());
        // Half a servant is of no use: the nodes that were spared would wait for the one that was not.
        write("memory", "memory.oom.group", "1".into());
    }
    if let Some(high) = limits.memory_high {
        write("memory", "memory.high", number(high));
    }
    if let Some(pids) = limits.pids {
        write("pids", "pids.max", number(pids));
    }
    if let Some(disk) = &cgroup.disk {
        for (key, limit) in [("rbps", limits.io_read), ("wbps", limits.io_write)] {
            if let Some(limit) = limit {
                let limit = number(limit);
                write("io", "io.max", format!("{disk} {key}={limit}"));
            }
        }
    }
    if let Some(cpuset) = &limits.cpuset {
        write("cpuset", "cpuset.cpus", cores::print(cpuset));
    }
}

/// A limit, or none again.
fn number(limit: u64) -> String {
    match limit {
        UNLIMITED => "max".to_owned(),
        limit => limit.to_string(),
    }
}

pub(super) fn limits(cgroup: &Cgroup) -> Limits {
    let number = |controller, name| read_number(&cgroup.file(controller, name)?);
    let cpus = cgroup.file("cpu", "cpu.max").and_then(|file| {
        let text = fs::read_to_string(file).ok()?;
        let (quota, period) = text.trim().split_once(' ')?;
        Some(quota.parse::<f64>().ok()? / period.parse::<f64>().ok()?)
    });
    let io = |key| {
        let disk = cgroup.disk.as_deref()?;
        read_of_device(&cgroup.file("io", "io.max")?, disk, key)
    };
    let cpuset = cgroup
        .file("cpuset", "cpuset.cpus")
        .and_then(|file| cores::parse(&fs::read_to_string(file).ok()?));
    Limits {
        cpus,
        cpu_weight: number("cpu", "cpu.weight"),
        memory: number("memory", "memory.max"),
        memory_high: number("memory", "memory.high"),
        pids: number("pids", "pids.max"),
        io_read: io("rbps"),
        io_write: io("wbps"),
        cpuset,
    }
}

/// Processor time, memory and pressure.
pub(super) fn usage(cgroup: &Cgroup) -> Usage {
    // There even where its controller is not enabled.
    let plain = |name: &str| Some(cgroup.leaves.first()?.directory.join(name));
    let stat = |field| read_field(&plain("cpu.stat")?, field);
    let memory = cgroup
        .file("memory", "memory.current")
        .and_then(|file| read_number(&file));
    Usage {
        cpu_usec: stat("usage_usec").unwrap_or(0),
        throttled_usec: stat("throttled_usec").unwrap_or(0),
        memory: memory.unwrap_or(0),
        reclaimable: cgroup
            .file("memory", "memory.stat")
            .and_then(|file| read_field(&file, "inactive_file"))
            .unwrap_or(0),
        pressure: cgroup
            .leaves
            .first()
            .and_then(|leaf| pressure_of_cgroup(&leaf.directory)),
        ..Usage::default()
    }
}
