//! Bounds on what a servant writes, beside the memory limit of its cgroup. Its root is read-only: it can only write to
//! file systems in its own memory, and to its log.

use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

/// Bytes of each scratch file system if neither a quota nor the servant's memory limits it.
const SCRATCH: u64 = 256 << 20;
/// Inodes of each scratch file system of a build, in which many compilers may run concurrently.
const BUILD_INODES: u64 = 1 << 20;

/// Bounds on what a servant writes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Quotas {
    /// Bytes of each of its file systems (`/tmp`, `/var/tmp`, `/root`, `/dev/shm`); by default half of its memory.
    pub scratch: Option<u64>,
    /// Number of files, directories and links in each of them.
    pub inodes: u64,
    /// Average bytes per second of its log.
    pub log_rate: u64,
}

impl Default for Quotas {
    fn default() -> Self {
        Self { scratch: None, inodes: 65_536, log_rate: 1 << 20 }
    }
}

impl Quotas {
    /// Returns the quotas of a build, whose output is awaited by a client and which is bounded as a whole.
    pub(crate) fn for_build() -> Self {
        Self { scratch: None, inodes: BUILD_INODES, log_rate: u64::MAX }
    }

    /// Returns the bytes of each scratch file system of a container with this memory limit.
    pub(crate) fn scratch_bytes(&self, memory: Option<u64>) -> u64 {
        let half = memory.map(|bytes| bytes / 2);
        self.scratch.or(half).unwrap_or(SCRATCH)
    }
}

/// Limits the average bytes per second, with bursts of ten seconds' worth: tracebacks come in bursts. Once that is used
/// up, nothing passes until one second's worth has accumulated: this keeps passages whole, and gaps few.
#[derive(Debug)]
pub(crate) struct RateLimit {
    per_second: u64,
    left: u64,
    at: Instant,
    refusing: bool,
}

const BURST: u64 = 10;

impl RateLimit {
    pub(crate) fn new(per_second: u64, now: Instant) -> Self {
        Self { per_second, left: per_second.saturating_mul(BURST), at: now, refusing: false }
    }

    /// Returns the limit in bytes per second.
    pub(crate) fn per_second(&self) -> u64 {
        self.per_second
    }

    /// Returns whether this number of bytes is admitted now.
    pub(crate) fn admits(&mut self, bytes: u64, now: Instant) -> bool {
        const SECOND: u128 = Duration::from_secs(1).as_nanos();
        let rate = u128::from(self.per_second);
        let since = now.saturating_duration_since(self.at).as_nanos();
        let come = rate * since / SECOND;
        if come > 0 {
            // Fractions of a byte are carried over.
            let taken = u64::try_from(come * SECOND / rate).unwrap_or(u64::MAX);
            self.at += Duration::from_nanos(taken);
            let come = u64::try_from(come).unwrap_or(u64::MAX);
            let most = self.per_second.saturating_mul(BURST);
            self.left = self.left.saturating_add(come).min(most);
        }
        let left = if self.refusing && self.left < self.per_second { None } else { self.left.checked_sub(bytes) };
        self.refusing = left.is_none();
        self.left = left.unwrap_or(self.left);
        !self.refusing
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bursts_pass_and_more_than_the_rate_does_not() {
        let start = Instant::now();
        let at = |milliseconds| start + Duration::from_millis(milliseconds);
        let mut rate = RateLimit::new(100, start);
        // (time in ms, bytes, passes)
        for (time, bytes, passes) in [
            (0, 1000, true),
            (0, 1, false),
            // A second's worth must have accumulated.
            (10, 1, false),
            (999, 1, false),
            (1000, 1, true),
            (1000, 99, true),
            (1500, 50, true),
            (1500, 1, false),
            // Never more than ten seconds' worth.
            (100_000, 1001, false),
            (100_000, 1000, true),
            (100_000, 1, false),
            // A clock that stands still, or goes backwards, adds nothing.
            (50_000, 1, false),
        ] {
            assert_eq!(rate.admits(bytes, at(time)), passes, "{bytes} at {time} ms");
        }
        let mut endless = RateLimit::new(u64::MAX, start);
        assert!((0..10).all(|_| endless.admits(1 << 40, start)));
    }

    #[test]
    fn what_passes_in_a_long_time_is_the_rate() {
        let start = Instant::now();
        let mut rate = RateLimit::new(1000, start);
        // Called far more often than bytes accumulate: fractions of a byte are not lost.
        let passed =
            (0..1_000_000_u64).filter(|micros| rate.admits(1, start + Duration::from_micros(micros * 100))).count();
        // 100 s at 1000 bytes per second, and the burst.
        assert!((108_000..=110_001).contains(&passed), "{passed}");
    }

    #[test]
    fn scratch_is_half_of_the_memory_unless_something_else_is_said() {
        let said = Quotas { scratch: Some(5), ..Quotas::default() };
        assert_eq!(said.scratch_bytes(Some(100)), 5);
        assert_eq!(Quotas::default().scratch_bytes(Some(100)), 50);
        assert_eq!(Quotas::default().scratch_bytes(None), SCRATCH);
    }
}
