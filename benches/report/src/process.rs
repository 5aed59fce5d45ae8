//! Resources of a process, from the kernel's counters.

use std::fmt::Display;
use std::fs;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, Result};

/// A running process.
#[derive(Debug, Clone)]
pub struct Process(PathBuf);

impl Process {
    /// This process.
    pub fn current() -> Self {
        Self(PathBuf::from("/proc/self"))
    }

    /// The process with this pid.
    pub fn from_pid(pid: impl Display) -> Self {
        Self(PathBuf::from(format!("/proc/{pid}")))
    }

    /// Returns the processor time of live threads whose names start with `threads`; exact, not in ticks.
    pub fn live_thread_time(&self, threads: &str) -> Result<Duration> {
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
    pub fn total_processor_time(&self) -> Result<Duration> {
        sum_ticks(&self.read("stat")?, 14).context("the processor time in stat")
    }

    /// Returns the resident memory in megabytes (10⁶).
    pub fn resident(&self) -> Result<f64> {
        self.megabytes("status", "VmRSS:")
    }

    /// Returns the anonymous resident memory in megabytes, which excludes files: what the process has allocated.
    pub fn anonymous(&self) -> Result<f64> {
        self.megabytes("status", "RssAnon:")
    }

    /// Returns the proportional set size in megabytes: shared pages are divided among their users.
    pub fn proportional(&self) -> Result<f64> {
        self.megabytes("smaps_rollup", "Pss:")
    }

    /// Returns the peak resident memory in megabytes, since [`reset_peak`](Self::reset_peak) if that was called.
    pub fn peak(&self) -> Result<f64> {
        self.megabytes("status", "VmHWM:")
    }

    /// Resets the peak of the resident memory (proc(5): 5 resets VmHWM).
    pub fn reset_peak(&self) -> Result<()> {
        Ok(fs::write(self.0.join("clear_refs"), "5")?)
    }

    /// Returns the number of open descriptors.
    pub fn descriptors(&self) -> Result<usize> {
        Ok(fs::read_dir(self.0.join("fd"))?.count())
    }

    /// Returns the number of threads.
    pub fn threads(&self) -> Result<usize> {
        Ok(fs::read_dir(self.0.join("task"))?.count())
    }

    fn read(&self, file: &str) -> Result<String> {
        let path = self.0.join(file);
        fs::read_to_string(&path).with_context(|| path.display().to_string())
    }

    fn megabytes(&self, file: &str, key: &str) -> Result<f64> {
        let text = self.read(file)?;
        let line = text.lines().find_map(|line| line.strip_prefix(key));
        let line = line.with_context(|| format!("{key} of {}", self.0.display()))?;
        let kilobytes: f64 = line.trim().trim_end_matches("kB").trim().parse()?;
        Ok(kilobytes * 1024.0 / 1e6)
    }
}

/// Returns the pid of the first child of a process, such as the init of a shim.
pub fn first_child(pid: i32) -> Result<i32> {
    let children = fs::read_to_string(format!("/proc/{pid}/task/{pid}/children"))?;
    let child = children.split_whitespace().next();
    Ok(child.with_context(|| format!("{pid} has no child"))?.parse()?)
}

/// Returns the processor time of the child processes that have ended and been waited for.
pub fn children_processor_time() -> Duration {
    let text = fs::read_to_string("/proc/self/stat").unwrap_or_default();
    sum_ticks(&text, 16).unwrap_or_default()
}

/// Sums two adjacent fields of `/proc/PID/stat` in hundredths of a second: 14 and 15 are utime and stime, 16 and 17
/// those of children (proc(5)). They follow the name, which may contain anything.
fn sum_ticks(stat: &str, first: usize) -> Option<Duration> {
    let (_, fields) = stat.rsplit_once(')')?;
    let mut fields = fields.split_whitespace().skip(first - 3);
    let mut next = || fields.next()?.parse::<u64>().ok();
    Some(Duration::from_millis(10 * (next()? + next()?)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_processs_name_does_not_matter() {
        let text = "12 (a ) b) S 1 2 3 4 5 6 7 8 9 10 250 50 7 1 20 0";
        assert_eq!(sum_ticks(text, 14), Some(Duration::from_secs(3)));
        assert_eq!(sum_ticks(text, 16), Some(Duration::from_millis(80)));
        assert_eq!(sum_ticks("12 (a) S 1", 14), None);
    }
}
