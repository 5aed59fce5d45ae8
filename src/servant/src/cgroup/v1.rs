//! Control files of cgroup v1 (kernel documentation, admin-guide/cgroup-v1).

use std::fs;
use std::io;
use std::path::Path;

use super::Cgroup;
use super::files::{read_field, read_number};
use crate::engine::Usage;
use crate::host::cgroup_pressure;
use crate::spec::{Limits, Size, UNLIMITED};

/// Scheduling period in microseconds; the kernel's default.
const PERIOD: f64 = 100_000.0;

const READ: &str = "blkio.throttle.read_bps_device";
const WRITE: &str = "blkio.throttle.write_bps_device";

/// Lower bound of `memory.limit_in_bytes` without a limit, which reads as the largest multiple of a page.
const NO_LIMIT: u64 = 1 << 62;

/// Limit of socket buffers, of UDP as well as TCP, despite the name. Version 1 counts them separately from memory, and
/// only once there is a limit; otherwise data that is sent and never read would not be counted at all.
const SOCKETS: &str = "memory.kmem.tcp.limit_in_bytes";

/// Returns the limit of socket buffers for a memory limit: a quarter of it.
fn socket_buffer_limit(memory: u64) -> u64 {
    match memory {
        UNLIMITED => UNLIMITED,
        memory => memory / 4,
    }
}

/// Returns whether this kernel counts socket buffers in the hierarchy of the memory controller mounted there.
pub fn counts_sockets(hierarchy: &Path) -> bool {
    hierarchy.join(SOCKETS).exists()
}

pub(super) fn set(cgroup: &Cgroup, limits: &Limits) {
    // The caller reads back whether a write took effect.
    let write =
        |controller, name, value: String| cgroup.control_file(controller, name).map(|file| fs::write(file, value));
    if let Some(cpus) = limits.cpus {
        write("cpu", "cpu.cfs_period_us", PERIOD.to_string());
        write("cpu", "cpu.cfs_quota_us", (cpus * PERIOD).round().max(1000.0).to_string());
    }
    if let Some(weight) = limits.cpu_weight {
        write("cpu", "cpu.shares", weight_to_shares(weight).to_string());
    }
    if let Some(memory) = limits.memory {
        let buffers = format_limit(socket_buffer_limit(memory.0), "-1");
        // The limit with swap must never be below the one without, whichever way both change: so both are written
        // twice.
        for _ in 0..2 {
            let memory = format_limit(memory.0, "-1");
            write("memory", "memory.limit_in_bytes", memory.clone());
            write("memory", "memory.memsw.limit_in_bytes", memory);
        }
        // Set before the processes create sockets: existing ones are not counted.
        write("memory", SOCKETS, buffers);
    }
    if let Some(pids) = limits.pids {
        write("pids", "pids.max", format_limit(pids, "max"));
    }
    if let Some(disk) = &cgroup.disk {
        for (name, limit) in [(READ, limits.io_read), (WRITE, limits.io_write)] {
            if let Some(limit) = limit {
                write("blkio", name, format!("{disk} {}", format_limit(limit.0, "0")));
            }
        }
    }
    if let Some(cpuset) = &limits.cpuset {
        write("cpuset", "cpuset.cpus", cpuset.to_string());
    }
}

/// Formats a limit; `none` is the file's notation for no limit.
fn format_limit(limit: u64, none: &str) -> String {
    match limit {
        UNLIMITED => none.to_owned(),
        limit => limit.to_string(),
    }
}

pub(super) fn limits(cgroup: &Cgroup) -> Limits {
    let number = |controller, name| read_number(&cgroup.control_file(controller, name)?);
    let period = number("cpu", "cpu.cfs_period_us");
    // -1 means no limit; it does not parse as u64, so it becomes `None`.
    let quota = number("cpu", "cpu.cfs_quota_us");
    let io = |name| read_field(&cgroup.control_file("blkio", name)?, cgroup.disk.as_deref()?).map(Size);
    let cpuset =
        cgroup.control_file("cpuset", "cpuset.cpus").and_then(|file| fs::read_to_string(file).ok()?.parse().ok());
    Limits {
        cpus: quota.zip(period).map(|(quota, period)| quota as f64 / period as f64),
        cpu_weight: number("cpu", "cpu.shares").map(shares_to_weight),
        memory: number("memory", "memory.limit_in_bytes").filter(|bytes| *bytes < NO_LIMIT).map(Size),
        // The nearest equivalent, soft_limit_in_bytes, throttles nobody.
        memory_high: None,
        pids: number("pids", "pids.max"),
        io_read: io(READ),
        io_write: io(WRITE),
        cpuset,
    }
}

/// Copies cores and memory nodes from the parents to cpusets that have none: a cpuset accepts no process before it has
/// both.
pub(super) fn inherit_cpuset(directory: &Path) -> io::Result<()> {
    let above = directory.parent().filter(|above| has_empty_cpuset(above));
    if let Some(above) = above {
        inherit_cpuset(above)?;
    }
    for name in ["cpuset.cpus", "cpuset.mems"] {
        let file = directory.join(name);
        if fs::read_to_string(&file)?.trim().is_empty()
            && let Some(above) = directory.parent()
        {
            fs::write(&file, fs::read_to_string(above.join(name))?)?;
        }
    }
    Ok(())
}

/// Returns whether a cpuset has no cores yet; false for directories that are not cpusets.
fn has_empty_cpuset(directory: &Path) -> bool {
    ["cpuset.cpus", "cpuset.mems"]
        .iter()
        .any(|name| fs::read_to_string(directory.join(name)).is_ok_and(|text| text.trim().is_empty()))
}

/// Reads processor time, memory and, if a v2 hierarchy is mounted as well, pressure.
pub(super) fn usage(cgroup: &Cgroup) -> Usage {
    let number = |controller, name| read_number(&cgroup.control_file(controller, name)?);
    let unified = cgroup.leaves.iter().find(|leaf| leaf.unified);
    let beside = || read_field(&unified?.directory.join("cpu.stat"), "usage_usec");
    let cpu = number("cpuacct", "cpuacct.usage").map(|nanoseconds| nanoseconds / 1000);
    let memory = number("memory", "memory.usage_in_bytes");
    let throttled = cgroup.control_file("cpu", "cpu.stat").and_then(|file| read_field(&file, "throttled_time"));
    Usage {
        cpu_usec: cpu.or_else(beside).unwrap_or(0),
        throttled_usec: throttled.unwrap_or(0) / 1000,
        memory: memory.unwrap_or(0),
        reclaimable: cgroup
            .control_file("memory", "memory.stat")
            .and_then(|file| read_field(&file, "total_inactive_file"))
            .unwrap_or(0),
        pressure: unified.and_then(|leaf| cgroup_pressure(&leaf.directory)),
        ..Usage::default()
    }
}

/// Converts a v2 weight (1..10000, default 100) to v1 shares (default 1024).
fn weight_to_shares(weight: u64) -> u64 {
    (weight * 1024 / 100).clamp(2, 262_144)
}

fn shares_to_weight(shares: u64) -> u64 {
    (shares * 100).div_ceil(1024).clamp(1, 10_000)
}

#[cfg(test)]
mod tests {
    #[test]
    fn weights_survive_the_way_to_v1_and_back() {
        for weight in [1, 50, 100, 333, 1000, 10_000] {
            assert!(super::shares_to_weight(super::weight_to_shares(weight)).abs_diff(weight) <= 1, "{weight}");
        }
        assert_eq!(super::weight_to_shares(100), 1024);
    }
}
