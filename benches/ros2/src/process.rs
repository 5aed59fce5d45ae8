//! Resources of a process, from the kernel's counters.

use std::fs;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, Result};

/// A running process.
#[derive(Debug, Clone)]
pub(crate) struct Process(PathBuf);

impl Process {
    /// This process.
    pub(crate) fn current() -> Self {
        Self(PathBuf::from("/proc/self"))
    }

    /// The process with this pid.
    pub(crate) fn from_pid(pid: u32) -> Self {
        Self(PathBuf::from(format!("/proc/{pid}")))
    }

    /// Returns the processor time of live threads whose names start with `threads`; exact, not in ticks.
    pub(crate) fn live_thread_time(&self, threads: &str) -> Result<Duration> {
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

    /// Returns the processor time of all threads, including those that have ended; in ticks of 10 ms.
    pub(crate) fn total_processor_time(&self) -> Result<Duration> {
        let text = fs::read_to_string(self.0.join("stat"))?;
        // The fields follow the name, which may contain any character: utime and stime are fields 14 and 15 (proc(5)).
        let (_, fields) = text.rsplit_once(')').context("a name in brackets")?;
        let ticks = fields.split_whitespace().skip(11).take(2);
        let ticks: u64 = ticks.filter_map(|ticks| ticks.parse::<u64>().ok()).sum();
        Ok(Duration::from_millis(ticks * 10))
    }

    /// Resident memory in megabytes (10⁶).
    pub(crate) fn resident(&self) -> Result<f64> {
        self.megabytes("status", "VmRSS:")
    }

    /// Peak resident memory in megabytes.
    pub(crate) fn peak(&self) -> Result<f64> {
        self.megabytes("status", "VmHWM:")
    }

    /// Number of open descriptors.
    pub(crate) fn descriptors(&self) -> Result<usize> {
        Ok(fs::read_dir(self.0.join("fd"))?.count())
    }

    /// Number of threads.
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
