//! Resources of a process, from the kernel's counters.

use std::fs;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};

/// Sampling interval of the peak.
const LOOK: Duration = Duration::from_millis(50);
/// The process has settled when its peak has not changed for `SETTLED`; the wait ends after `PATIENCE` in any case.
const SETTLED: Duration = Duration::from_secs(1);
const PATIENCE: Duration = Duration::from_secs(30);

/// A running process, by its pid.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Process(pub(crate) i32);

impl Process {
    /// Resident memory in megabytes (10⁶).
    pub(crate) fn resident(self) -> Result<f64> {
        self.status_field("VmRSS:")
    }

    /// Peak resident memory in megabytes since [`reset_peak`](Self::reset_peak).
    pub(crate) fn peak(self) -> Result<f64> {
        self.status_field("VmHWM:")
    }

    fn status_field(self, key: &str) -> Result<f64> {
        let text = fs::read_to_string(format!("/proc/{}/status", self.0))?;
        let line = text.lines().find_map(|line| line.strip_prefix(key));
        let line = line.with_context(|| format!("{key} of process {}", self.0))?;
        let kilobytes: f64 = line.trim().trim_end_matches("kB").trim().parse()?;
        Ok(kilobytes * 1024.0 / 1e6)
    }

    pub(crate) fn reset_peak(self) -> Result<()> {
        // 5 resets VmHWM (proc(5)).
        fs::write(format!("/proc/{}/clear_refs", self.0), "5")?;
        Ok(())
    }

    /// Waits until the memory of the process no longer grows.
    pub(crate) fn wait_until_settled(self) -> Result<()> {
        let began = Instant::now();
        let (mut peak, mut since) = (self.peak()?, Instant::now());
        while since.elapsed() < SETTLED && began.elapsed() < PATIENCE {
            std::thread::sleep(LOOK);
            let now = self.peak()?;
            if now > peak {
                (peak, since) = (now, Instant::now());
            }
        }
        Ok(())
    }

    /// Processor time so far.
    pub(crate) fn processor_time(self) -> Result<Duration> {
        let text = fs::read_to_string(format!("/proc/{}/stat", self.0))?;
        // The fields follow the name, which may contain any character.
        let (_, fields) = text.rsplit_once(')').context("a name in brackets")?;
        let fields: Vec<&str> = fields.split_whitespace().collect();
        let ticks = |at: usize| -> Result<u64> { Ok(fields.get(at).context("a field")?.parse()?) };
        // utime and stime, in hundredths of a second on every Linux.
        Ok(Duration::from_millis(10 * (ticks(11)? + ticks(12)?)))
    }
}
