//! Control files of cgroup v1 (kernel documentation, admin-guide/cgroup-v1).

use std::fs;
use std::io;
use std::path::Path;

use super::files::{read_field, read_number};
use super::{Cgroup, cores};
use crate::engine::Usage;
use crate::host::pressure_of_cgroup;
use crate::spec::{Limits, UNLIMITED};

/// Microseconds; the kernel's default.
const PERIOD: f64 = 100_000.0;

const READ: &str = "blkio.throttle.read_bps_device";
const WRITE: &str = "blkio.throttle.write_bps_device";

/// What `memory.limit_in_bytes` reads when there is no limit: the largest multiple of a page.
const NO_LIMIT: u64 = 1 << 62;

/// Buffers of sockets, of UDP as of TCP, whatever its name says. Version 1 counts them beside the memory, and only once there is
/// a limit; what a process sends and nobody reads would else be nobody's.
const SOCKETS: &str = "memory.kmem.tcp.limit_in_bytes";

/// What buffers of sockets may have beside so much memory: a quarter of it.
fn buffers_of_sockets(memory: u64) -> u64 {
    match memory {
        UNLIMITED => UNLIMITED,
        memory => memory / 4,
    }
}

/// Whether this kernel counts buffers of sockets in the hierarchy of the memory controller that is mounted there.
pub fn counts_sockets(hierarchy: &Path) -> bool {
    hierarchy.join(SOCKETS).exists()
}

pub(super) fn set(cgroup: &Cgroup, limits: &Limits) {
    // Whether a write took effect is read back by the caller.
    let write = |controller, name, value: String| {
        cgroup
            .file(controller, name)
            .map(|file| fs::write(file, value))
    };
    if let Some(cpus) = limits.cpus {
        write("cpu", "cpu.cfs_period_us", PERIOD.to_string());
        write(
            "cpu",
            "cpu.cfs_quota_us",
            (cpus * PERIOD).round().max(1000.0).to_string(),
        );
    }
    if let Some(weight) = limits.cpu_weight {
        write("cpu", "cpu.shares", shares(weight).to_string());
    }
    if let Some(memory) = limits.memory {
        let buffers = number(buffers_of_sockets(memory), "-1");
        // With swap may not be below without swap, in neither direction of the change: so both, twice.
        for _ in 0..2 {
            let memory = number(memory, "-1");
            write("memory", "memory.limit_in_bytes", memory.clone());
            write("memory", "memory.memsw.limit_in_bytes", memory);
        }
        // Set before its processes make sockets: those that are there already are not counted.
        write("memory", SOCKETS, buffers);
    }
    if let Some(pids) = limits.pids {
        write("pids", "pids.max", number(pids, "max"));
    }
    if let Some(disk) = &cgroup.disk {
        for (name, limit) in [(READ, limits.io_read), (WRITE, limits.io_write)] {
            if let Some(limit) = limit {
                write("blkio", name, format!("{disk} {}", number(limit, "0")));
            }
        }
    }
    if let Some(cpuset) = &limits.cpuset {
        write("cpuset", "cpuset.cpus", cores::print(cpuset));
    }
}

/// A limit, or what stands for none in its file.
fn number(limit: u64, none: &str) -> String {
    match limit {
        UNLIMITED => none.to_owned(),
        limit => limit.to_string(),
    }
}

pub(super) fn limits(cgroup: &Cgroup) -> Limits {
    let number = |controller, name| read_number(&cgroup.file(controller, name)?);
    let period = number("cpu", "cpu.cfs_period_us");
    // -1, which is no limit, is no u64 and so reads as none.
    let quota = number("cpu", "cpu.cfs_quota_us");
    let io = |name| read_field(&cgroup.file("blkio", name)?, cgroup.disk.as_deref()?);
    let cpuset = cgroup
        .file("cpuset", "cpuset.cpus")
        .and_then(|file| cores::parse(&fs::read_to_string(file).ok()?));
    Limits {
        cpus: quota
            .zip(period)
            .map(|(quota, period)| quota as f64 / period as f64),
        cpu_weight: number("cpu", "cpu.shares").map(weight),
        memory: number("memory", "memory.limit_in_bytes").filter(|bytes| *bytes < NO_LIMIT),
        // Its nearest likeness, soft_limit_in_bytes, slows nobody down.
        memory_high: None,
        pids: number("pids", "pids.max"),
        io_read: io(READ),
        io_write: io(WRITE),
        cpuset,
    }
}

/// A cpuset takes no process before it has cores and memory nodes: each that has none is given those of the one above.
pub(super) fn hand_down_cores(directory: &Path) -> io::Result<()> {
    let above = directory.parent().filter(|above| is_empty(above));
    if let Some(above) = above {
        hand_down_cores(above)?;
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

/// Whether a cpuset has no cores yet; what is no cpuset is none of ours.
fn is_empty(directory: &Path) -> bool {
    ["cpuset.cpus", "cpuset.mems"].iter().any(|name| {
        fs::read_to_string(directory.join(name)).is_ok_and(|text| text.trim().is_empty())
    })
}

/// Processor time, memory and, where a v2 hierarchy is mounted beside, pressure.
pub(super) fn usage(cgroup: &Cgroup) -> Usage {
    let number = |controller, name| read_number(&cgroup.file(controller, name)?);
    let unified = cgroup.leaves.iter().find(|leaf| leaf.unified);
    let beside = || read_field(&unified?.directory.join("cpu.stat"), "usage_usec");
    let cpu = number("cpuacct", "cpuacct.usage").map(|nanoseconds| nanoseconds / 1000);
    let memory = number("memory", "memory.usage_in_bytes");
    let throttled = cgroup
        .file("cpu", "cpu.stat")
        .and_then(|file| read_field(&file, "throttled_time"));
    Usage {
        cpu_usec: cpu.or_else(beside).unwrap_or(0),
        throttled_usec: throttled.unwrap_or(0) / 1000,
        memory: memory.unwrap_or(0),
        reclaimable: cgroup
            .file("memory", "memory.stat")
            .and_then(|file| read_field(&file, "total_inactive_file"))
            .unwrap_or(0),
        pressure: unified.and_then(|leaf| pressure_of_cgroup(&leaf.directory)),
        ..Usage::default()
    }
}

/// A v2 weight (1..10000, 100 by default) as v1 shares (1024 by default).
fn shares(weight: u64) -> u64 {
    (weight * 1024 / 100).clamp(2, 262_144)
}

fn weight(shares: u64) -> u64 {
    (shares * 100).div_ceil(1024).clamp(1, 10_000)
}

#[cfg(test)]
mod tests {
    #[test]
    fn weights_survive_the_way_to_v1_and_back() {
        for weight in [1, 50, 100, 333, 1000, 10_000] {
            assert!(
                super::weight(super::shares(weight)).abs_diff(weight) <= 1,
                "{weight}"
            );
        }
        assert_eq!(super::shares(100), 1024);
    }
}
