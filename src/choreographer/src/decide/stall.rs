//! Detects a stalled machine: it swaps, or everything waits for memory. Nothing more is admitted then.
//!
//! Memory is never promised twice, but peaks are not promised, and the machine has other users. The kernel's pressure
//! stall information (kernel documentation, accounting/psi) shows when that went wrong: `full` of memory is the
//! fraction of time in which nothing could run because everything waited for memory. Servants that wait at their own
//! limits count as well if nothing else runs; so it says something about the machine only while its memory is short.

use std::time::{Duration, Instant};

/// Percentage of the last ten seconds in which everything waited for memory, from which on the machine stalls.
const STALLS: f64 = 10.0;
/// Percentage below which it no longer stalls.
const FLOWS: f64 = 5.0;
/// Percentage of available memory from which on the machine itself is not short of memory.
const PLENTY: f64 = 25.0;
/// Bytes per second read from swap, from which on the machine swaps.
const SWAPS: f64 = (1 << 20) as f64;
/// Bytes per second below which it no longer swaps.
const CALM_SWAPS: f64 = SWAPS / 4.0;
/// Time without signs after which a stall has ended.
const QUIET: Duration = Duration::from_secs(5);

/// Readings of the kernel.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PressureReading {
    /// `full avg10` of memory in percent; `None` if the kernel does not provide it.
    pub memory_full: Option<f64>,
    /// `MemAvailable` in percent of all memory; `None` if the kernel does not provide it.
    pub available: Option<f64>,
    /// Bytes per second read from swap since the last reading.
    pub swapped_in: f64,
}

/// State of the stall detection between readings.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct StallDetector {
    /// Time of the last reading that showed a stall, while stalled.
    seen: Option<Instant>,
}

impl StallDetector {
    /// Returns the reason why nothing is admitted at `now`, if so.
    pub fn judge(&mut self, reading: PressureReading, now: Instant) -> Option<String> {
        let full = reading.memory_full.unwrap_or(0.0);
        let (stalls, swaps) = match self.seen {
            None => (STALLS, SWAPS),
            Some(_) => (FLOWS, CALM_SWAPS),
        };
        let short = reading.available.is_none_or(|percent| percent < PLENTY);
        let why = if short && full >= stalls {
            format!("this machine stalls: all tasks waited for memory in {full:.0} % of the last 10 s")
        } else if reading.swapped_in >= swaps {
            let bytes = reading.swapped_in.max(0.0) as u64;
            format!("this machine swaps: it reads {} per second from swap", api::Size(bytes))
        } else {
            match self.seen {
                Some(seen) if now.saturating_duration_since(seen) < QUIET => {
                    return Some("this machine stalled a moment ago".to_owned());
                }
                _ => {
                    self.seen = None;
                    return None;
                }
            }
        };
        self.seen = Some(now);
        Some(why)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn reading(memory_full: f64, swapped_in: f64) -> PressureReading {
        PressureReading { memory_full: Some(memory_full), available: Some(3.0), swapped_in }
    }

    #[test]
    fn servants_that_wait_at_their_own_limits_are_not_the_machine() {
        for (available, stalls) in [(Some(80.0), false), (Some(24.9), true), (None, true)] {
            let of = PressureReading { available, ..reading(90.0, 0.0) };
            let why = StallDetector::default().judge(of, Instant::now());
            assert_eq!(why.is_some(), stalls, "{available:?}: {why:?}");
        }
    }

    #[test]
    fn it_begins_at_one_bound_and_ends_at_a_lower_one() {
        let began = Instant::now();
        let mut stall = StallDetector::default();
        for (second, of, expected) in [
            (0, reading(9.9, SWAPS - 1.0), None),
            (1, PressureReading::default(), None),
            (2, reading(12.4, 0.0), Some("waited for memory in 12 %")),
            (3, reading(5.0, 0.0), Some("waited for memory in 5 %")),
            (4, reading(4.9, CALM_SWAPS), Some("swaps: it reads 256K per second")),
            (5, reading(0.0, 0.0), Some("a moment ago")),
            (8, reading(4.9, 0.0), Some("a moment ago")),
            (9, reading(4.9, 0.0), None),
            (10, reading(9.9, 0.0), None),
            (11, reading(0.0, SWAPS), Some("swaps")),
        ] {
            let why = stall.judge(of, began + Duration::from_secs(second));
            match (&why, expected) {
                (None, None) => {}
                (Some(why), Some(words)) => assert!(why.contains(words), "{second}: {why}"),
                _ => panic!("{second}: {why:?}, not {expected:?}"),
            }
        }
    }

    proptest! {
        #[test]
        fn it_does_not_come_and_go(readings in prop::collection::vec((0.0f64..20.0, 0.0f64..2.0), 1..200)) {
            let began = Instant::now();
            let mut stall = StallDetector::default();
            let mut ended: Option<u64> = None;
            let mut before = false;
            let mut last = 0;
            for (second, (full, swaps)) in (0u64..).zip(readings) {
                let of = reading(full, swaps * SWAPS);
                let stalls = stall.judge(of, began + Duration::from_secs(second)).is_some();
                if full >= STALLS || swaps >= 1.0 {
                    prop_assert!(stalls);
                    last = second;
                }
                if before && !stalls {
                    prop_assert!(second - last >= QUIET.as_secs(), "it has ended too soon");
                    prop_assert!(ended.is_none_or(|ended| second - ended >= QUIET.as_secs()));
                    ended = Some(second);
                }
                before = stalls;
            }
        }
    }
}
