//! Control files of cgroup v2 (kernel documentation, admin-guide/cgroup-v2).

use std::fs;

use super::Cgroup;
use super::files::{read_field, read_number};
use crate::spec::Limits;

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
        write("memory", "memory.max", memory.to_string());
        write("memory", "memory.swap.max", "0".into());
    }
    if let Some(pids) = limits.pids {
        write("pids", "pids.max", pids.to_string());
    }
}

pub(super) fn limits(cgroup: &Cgroup) -> Limits {
    let number = |controller, name| read_number(&cgroup.file(controller, name)?);
    let cpus = cgroup.file("cpu", "cpu.max").and_then(|file| {
        let text = fs::read_to_string(file).ok()?;
        let (quota, period) = text.trim().split_once(' ')?;
        Some(quota.parse::<f64>().ok()? / period.parse::<f64>().ok()?)
    });
    Limits {
        cpus,
        cpu_weight: number("cpu", "cpu.weight"),
        memory: number("memory", "memory.max"),
        pids: number("pids", "pids.max"),
    }
}

/// Microseconds of CPU and bytes of memory.
pub(super) fn usage(cgroup: &Cgroup) -> (u64, u64) {
    // cpu.stat has usage_usec even where the cpu controller is not enabled.
    let cpu = cgroup
        .leaves
        .first()
        .and_then(|leaf| read_field(&leaf.directory.join("cpu.stat"), "usage_usec"));
    let memory = cgroup
        .file("memory", "memory.current")
        .and_then(|file| read_number(&file));
    (cpu.unwrap_or(0), memory.unwrap_or(0))
}
