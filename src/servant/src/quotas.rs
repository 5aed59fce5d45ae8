//! What a servant may write, beside the memory that its cgroup bounds. Its root is read-only: what it writes goes into file
//! systems in its own memory, and into its log.

use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

/// Bytes of each scratch file system where neither these nor the servant's memory bound it.
const SCRATCH: u64 = 256 << 20;
/// Files of each scratch file system of a build: those of many compilers side by side.
const BUILD_INODES: u64 = 1 << 20;

/// Bounds of what a servant writes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Quotas {
    /// Bytes of each of its file systems (`/tmp`, `/var/tmp`, `/root`, `/dev/shm`); by default half of its memory.
    pub scratch: Option<u64>,
    /// Files, directories and links in each of them.
    pub inodes: u64,
    /// Bytes a second of its log, on the average.
    pub log_rate: u64,
}

impl Default for Quotas {
    fn default() -> Self {
        Self {
            scratch: None,
            inodes: 65_536,
            log_rate: 1 << 20,
        }
    }
}

impl Quotas {
    /// Those of a build, which is bounded as a whole and whose output somebody waits for.
    pub(crate) fn of_build() -> Self {
        Self {
            scratch: None,
            inodes: BUILD_INODES,
            log_rate: u64::MAX,
        }
    }

    /// Bytes of each scratch file system of a container with so much memory.
    pub(crate) fn scratch(&self, memory: Option<u64>) -> u64 {
        let half = memory.map(|bytes| bytes / 2);
        self.scratch.or(half).unwrap_or(SCRATCH)
    }
}

/// Lets through so many bytes a second on the average, and so many of ten seconds at once: tracebacks come in bursts. Who has
/// used that up waits until a second's worth has come together: so there are whole passages, and few gaps to tell of.
#[derive(Debug)]
pub(crate) struct Rate {
    per_second: u64,
    left: u64,
    at: Instant,
    refusing: bool,
}

const BURST: u64 = 10;

impl Rate {
    pub(crate) fn new(per_second: u64, now: Instant) -> Self {
        Self {
            per_second,
            left: per_second.saturating_mul(BURST),
            at: now,
            refusing: false,
        }
    }

    /// Bytes a second.
    pub(crate) fn per_second(&self) -> u64 {
        self.per_second
    }

    /// Whether so many bytes may pass now.
    pub(crate) fn passes(&mut self, bytes: u64, now: Instant) -> bool {
        const SECOND: u128 = Duration::from_secs(1).as_nanos();
        let rate = u128::from(self.per_second);
        let since = now.saturating_duration_since(self.at).as_nanos();
        let come = rate * since / SECOND;
        if come > 0 {
            // What is less than a byte comes with the next ones.
            let taken = u64::try_from(come * SECOND / rate).unwrap_or(u64::MAX);
            self.at += Duration::from_nanos(taken);
            let come = u64::try_from(come).unwrap_or(u64::MAX);
            let most = self.per_second.saturating_mul(BURST);
            self.left = self.left.saturating_add(come).min(most);
        }
        let left = match self.refusing && self.left < self.per_second {
            true => None,
            false => self.left.checked_sub(bytes),
        };
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
        let mut rate = Rate::new(100, start);
        // (time in ms, bytes, passes)
        for (time, bytes, passes) in [
            (0, 1000, true),
            (0, 1, false),
            // A second's worth must have come together.
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
            // A clock that stands still, or goes back, gives nothing.
            (50_000, 1, false),
        ] {
            assert_eq!(rate.passes(bytes, at(time)), passes, "{bytes} at {time} ms");
        }
        let mut endless = Rate::new(u64::MAX, start);
        assert!((0..10).all(|_| endless.passes(1 << 40, start)));
    }

    #[test]
    fn what_passes_in_a_long_time_is_the_rate() {
        let start = Instant::now();
        let mut rate = Rate::new(1000, start);
        // Asked far more often than bytes come: what is less than a byte is not lost.
        let passed = (0..1_000_000_u64)
            .filter(|micros| rate.passes(1, start + Duration::from_micros(micros * 100)))
            .count();
        // 100 s at 1000 a second, and the burst.
        assert!((108_000..=110_001).contains(&passed), "{passed}");
    }

    #[test]
    fn scratch_is_half_of_the_memory_unless_something_else_is_said() {
        let said = Quotas {
            scratch: Some(5),
            ..Quotas::default()
        };
        assert_eq!(said.scratch(Some(100)), 5);
        assert_eq!(Quotas::default().scratch(Some(100)), 50);
        assert_eq!(Quotas::default().scratch(None), SCRATCH);
    }
}
