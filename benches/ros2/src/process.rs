//! What a process takes, as the kernel counts it.

use std::fs;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, Result};

/// A running process.
#[derive(Debug, Clone)]
pub(crate) struct Process(PathBuf);

impl Process {
    /// This one.
    pub(crate) fn this() -> Self {
        Self(PathBuf::from("/proc/self"))
    }

    /// The one with this number.
    pub(crate) fn of(pid: u32) -> Self {
        Self(PathBuf::from(format!("/proc/{pid}")))
    }

    /// Time on a processor so far, of the threads that have not ended and whose names begin so; exactly, not in ticks.
    pub(crate) fn processor(&self, threads: &str) -> Result<Duration> {
        let mut nanoseconds = 0;
        for task in fs::read_dir(self.0.join("task"))? {
            let task = task?.path();
            if !fs::read_to_string(task.join("comm"))?.starts_with(threads) {
                continue;
            }
            let text = fs::read_to_string(task.join("schedstat"))?;
            let spent = text.split_whitespace().next().context("schedstat")?;
            nanoseconds += spent.parse::<u64>()?;
        }
        Ok(Duration::from_nanos(nanoseconds))
    }

    /// Time on a processor so far, of threads that have ended, too; in ticks of 10 ms.
    pub(crate) fn processor_in_all(&self) -> Result<Duration> {
        let text = fs::read_to_string(self.0.join("stat"))?;
        // Behind the name, which may hold anything: utime and stime are fields 14 and 15 (proc(5)).
        let (_, fields) = text.rsplit_once(')').context("a name in brackets")?;
        let ticks = fields.split_whitespace().skip(11).take(2);
        let ticks: u64 = ticks.filter_map(|ticks| ticks.parse::<u64>().ok()).sum();
        Ok(Duration::from_millis(ticks * 10))
    }

    /// Resident megabytes (10⁶) now.
    pub(crate) fn resident(&self) -> Result<f64> {
        self.megabytes("status", "VmRSS:")
    }

    /// The most it has been.
    pub(crate) fn peak(&self) -> Result<f64> {
        self.megabytes("status", "VmHWM:")
    }

    /// How many descriptors are open.
    pub(crate) fn descriptors(&self) -> Result<usize> {
        Ok(fs::read_dir(self.0.join("fd"))?.count())
    }

    /// How many threads there are.
    pub(crate) fn threads(&self) -> Result<usize> {
        Ok(fs::read_dir(self.0.join("task"))?.count())
    }

    fn megabytes(&self, file: &str, key: &str) -> Result<f64> {
        let text = fs::read_to_string(self.0.join(file))?;
        let line = text.lines().find_map(|line| line.strip_prefix(key));
        let line = line.with_context(|| format!("{key} of {}", self.0.display()))?;
        let kilobytes: f64 = line.trim().trim_end_matches("kB").trim().parse()?;
        Ok(kilobytes * 1024.0 / 1e6)
    }
}
