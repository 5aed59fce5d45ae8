//! The kernel's counters of the machine, the daemon, its servants and the robots' process.

use anyhow::{Context, Result};
use bench_report::Process;
use serde::{Deserialize, Serialize};
use support::daemon::Daemon;

use crate::experiments::crowd::{self, SHORT};

/// Ticks per second in `/proc`: `USER_HZ`, which is 100 on all machines that run servants (proc(5)).
const TICKS: f64 = 100.0;

/// Processor time so far, in seconds.
#[derive(Debug, Clone, Copy)]
pub(super) struct TimeCounters {
    machine: f64,
    daemon: f64,
    servants: f64,
    robots: f64,
}

/// Cores used during a period.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct CoreUsage {
    pub(super) machine: f64,
    pub(super) daemon: f64,
    pub(super) servants: f64,
    /// By the robots, whose process also makes the measurements.
    pub(super) robots: f64,
}

impl CoreUsage {
    pub(super) fn request_cores(&self) -> f64 {
        self.daemon + self.servants + self.robots
    }
}

impl TimeCounters {
    pub(super) fn read(daemon: &Daemon) -> Result<Self> {
        let machine = std::fs::read_to_string("/proc/stat").context("/proc/stat")?;
        let of_process = |process: Process| -> Result<f64> { Ok(process.total_processor_time()?.as_secs_f64()) };
        Ok(Self {
            machine: parse_machine_time(&machine).context("/proc/stat")?,
            daemon: of_process(Process::from_pid(daemon.pid()))?,
            servants: crowd::usage(daemon, SHORT)?.0,
            robots: of_process(Process::current())?,
        })
    }

    /// Returns the cores used since `before`, `seconds` ago.
    pub(super) fn cores_since(&self, before: &Self, seconds: f64) -> CoreUsage {
        CoreUsage {
            machine: (self.machine - before.machine) / seconds,
            daemon: (self.daemon - before.daemon) / seconds,
            servants: (self.servants - before.servants) / seconds,
            robots: (self.robots - before.robots) / seconds,
        }
    }
}

/// Parses the non-idle core seconds of `/proc/stat`. Guest time is included in user time.
fn parse_machine_time(text: &str) -> Option<f64> {
    let line = text.lines().find_map(|line| line.strip_prefix("cpu "))?;
    let ticks: Vec<f64> = line.split_whitespace().map(|word| word.parse().ok()).collect::<Option<_>>()?;
    // user, nice, system, idle, iowait, irq, softirq, steal
    let used = [0, 1, 2, 5, 6].map(|index| ticks.get(index).copied().unwrap_or(0.0));
    (ticks.len() >= 4).then(|| used.iter().sum::<f64>() / TICKS)
}

/// Returns the memory available without swapping and the total memory, in bytes.
pub(super) fn available_memory() -> Result<(f64, f64)> {
    let text = std::fs::read_to_string("/proc/meminfo").context("/proc/meminfo")?;
    parse_memory(&text).context("MemAvailable and MemTotal of /proc/meminfo")
}

fn parse_memory(text: &str) -> Option<(f64, f64)> {
    let bytes = |name: &str| -> Option<f64> {
        let line = text.lines().find_map(|line| line.strip_prefix(name))?;
        let kib: f64 = line.trim().trim_end_matches("kB").trim().parse().ok()?;
        Some(kib * 1024.0)
    };
    Some((bytes("MemAvailable:")?, bytes("MemTotal:")?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn idle_time_is_not_use() {
        let text = "cpu  100 10 40 9000 500 20 30 7 0 0\ncpu0 1 1 1 1\n";
        assert_eq!(parse_machine_time(text), Some(2.0));
        assert_eq!(parse_machine_time("intr 1"), None);
    }

    #[test]
    fn memory_is_in_bytes() {
        let text = "MemTotal:       2000 kB\nMemFree:   1 kB\nMemAvailable:   1000 kB\n";
        assert_eq!(parse_memory(text), Some((1_024_000.0, 2_048_000.0)));
        assert_eq!(parse_memory("MemTotal: 1 kB"), None);
    }
}
