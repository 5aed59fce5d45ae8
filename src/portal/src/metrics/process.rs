//! Metrics of the daemon's own process, under the names that Prometheus's client libraries give them, and of its heap.

use nix::unistd::{SysconfVar, sysconf};
use procfs::process::Process;

use super::exposition::{write_family, write_gauge};

/// Writes the metrics of this process. Those that the kernel does not tell are missing.
pub(super) fn write_process_metrics(out: &mut String) {
    let Ok(process) = Process::myself() else {
        return;
    };
    let units = (read_system_value(SysconfVar::CLK_TCK), read_system_value(SysconfVar::PAGE_SIZE));
    if let (Ok(stat), (Some(ticks), Some(page_size))) = (process.stat(), units) {
        let worked = (stat.utime + stat.stime) as f64 / ticks;
        let rows = [(String::new(), worked)];
        write_family(out, "process_cpu_seconds_total", "counter", "Processor time of the daemon.", rows);
        if let Some(booted) = read_boot_time() {
            let begin = booted + stat.starttime as f64 / ticks;
            gauge(out, "process_start_time_seconds", "When the daemon started, in seconds since 1970.", begin);
        }
        let resident = stat.rss as f64 * page_size;
        gauge(out, "process_resident_memory_bytes", "Resident memory of the daemon.", resident);
    }
    if let Ok(open) = process.fd_count() {
        gauge(out, "process_open_fds", "Open descriptors of the daemon.", open as f64);
    }
    let limit = process.limits().map(|limits| limits.max_open_files.soft_limit);
    if let Ok(procfs::process::LimitValue::Value(limit)) = limit {
        gauge(out, "process_max_fds", "Limit of the daemon's open descriptors.", limit as f64);
    }
    if let Some(allocated) = servant::process::allocated_bytes() {
        let help = "Memory that the daemon allocated and did not free.";
        gauge(out, "cloudroid_heap_bytes", help, allocated as f64);
    }
}

// procfs would read units, and the boot time with them, by the auxiliary vector, which Linux before 6.4 does not show
// a process that gave up privileges, and panic.

/// Returns a value of sysconf(3).
fn read_system_value(of: SysconfVar) -> Option<f64> {
    Some(sysconf(of).ok()?? as f64)
}

/// Returns when the host started, in seconds since 1970 (`btime` of proc_stat(5)).
fn read_boot_time() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/stat").ok()?;
    stat.lines().find_map(|line| line.strip_prefix("btime "))?.trim().parse().ok()
}

fn gauge(out: &mut String, name: &str, help: &str, value: f64) {
    write_gauge(out, name, help, [(String::new(), value)]);
}
