//! What the kernel has counted of the node, the daemon, its servants and the robots' process.

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use support::daemon::Daemon;

use crate::experiments::crowd::{self, SHORT};

/// Ticks a second in files of `/proc`: `USER_HZ`, which is 100 on all machines that servants run on (proc(5)).
const TICKS: f64 = 100.0;

/// Seconds of processor time so far.
#[derive(Debug, Clone, Copy)]
pub(super) struct Counters {
    machine: f64,
    daemon: f64,
    servants: f64,
    robots: f64,
}

/// Cores that were used in a time.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Cores {
    /// By everything on the machine.
    pub(super) machine: f64,
    /// By the daemon, which has the portal.
    pub(super) daemon: f64,
    /// By the servants.
    pub(super) servants: f64,
    /// By the robots, whose process measures, too.
    pub(super) robots: f64,
}

impl Cores {
    /// Of what requests are made of.
    pub(super) fn requests(&self) -> f64 {
        self.daemon + self.servants + self.robots
    }
}

impl Counters {
    pub(super) fn now(daemon: &Daemon) -> Result<Self> {
        let read = |path: String| std::fs::read_to_string(&path).context(path);
        let of_process = |pid: String| -> Result<f64> {
            let path = format!("/proc/{pid}/stat");
            process(&read(path.clone())?).context(path)
        };
        Ok(Self {
            machine: machine(&read("/proc/stat".to_owned())?).context("/proc/stat")?,
            daemon: of_process(daemon.pid().to_string())?,
            servants: crowd::usage(daemon, SHORT)?.0,
            robots: of_process("self".to_owned())?,
        })
    }

    /// What was used since then, in so many seconds.
    pub(super) fn since(&self, before: &Self, seconds: f64) -> Cores {
        Cores {
            machine: (self.machine - before.machine) / seconds,
            daemon: (self.daemon - before.daemon) / seconds,
            servants: (self.servants - before.servants) / seconds,
            robots: (self.robots - before.robots) / seconds,
        }
    }
}

/// Seconds in which cores were not idle, of `/proc/stat`. Time of guests is in that of users already.
fn machine(text: &str) -> Option<f64> {
    let line = text.lines().find_map(|line| line.strip_prefix("cpu "))?;
    let ticks: Vec<f64> = line
        .split_whitespace()
        .map(|word| word.parse().ok())
        .collect::<Option<_>>()?;
    // user, nice, system, idle, iowait, irq, softirq, steal
    let used = [0, 1, 2, 5, 6].map(|index| ticks.get(index).copied().unwrap_or(0.0));
    (ticks.len() >= 4).then(|| used.iter().sum::<f64>() / TICKS)
}

/// Seconds of a process with all its threads, of `/proc/PID/stat`: utime and stime. Its name, in brackets, may have spaces.
fn process(text: &str) -> Option<f64> {
    let (_, rest) = text.rsplit_once(')')?;
    let mut fields = rest.split_whitespace().skip(11);
    let user: f64 = fields.next()?.parse().ok()?;
    let system: f64 = fields.next()?.parse().ok()?;
    Some((user + system) / TICKS)
}

/// Memory that could be used without swapping, and all, bytes.
pub(super) fn available_memory() -> Result<(f64, f64)> {
    let text = std::fs::read_to_string("/proc/meminfo").context("/proc/meminfo")?;
    memory(&text).context("MemAvailable and MemTotal of /proc/meminfo")
}

fn memory(text: &str) -> Option<(f64, f64)> {
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
        assert_eq!(machine(text), Some(2.0));
        assert_eq!(machine("intr 1"), None);
    }

    #[test]
    fn a_processs_name_does_not_matter() {
        let text = "12 (a ) b) S 1 2 3 4 5 6 7 8 9 10 250 50 0 0 20 0";
        assert_eq!(process(text), Some(3.0));
        assert_eq!(process("12 (a) S 1"), None);
    }

    #[test]
    fn memory_is_in_bytes() {
        let text = "MemTotal:       2000 kB\nMemFree:   1 kB\nMemAvailable:   1000 kB\n";
        assert_eq!(memory(text), Some((1_024_000.0, 2_048_000.0)));
        assert_eq!(memory("MemTotal: 1 kB"), None);
    }
}
