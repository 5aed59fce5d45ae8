//! Whether the machine stalls: it swaps, or all that runs waits for memory. Then nobody more is admitted.
//!
//! Memory is never promised twice, but peaks are not promised, and the machine has other users. What the kernel counts of
//! waiting says when that went wrong (pressure stall information, kernel documentation, accounting/psi): `full` of memory is
//! the time in which nothing could run because all waited for memory. Servants that wait at limits of their own count there,
//! too, where nothing else runs; so it says something of the machine only while its memory is short.

use std::time::{Duration, Instant};

/// Percent of the last ten seconds in which all waited for memory: from so much on the machine stalls.
const STALLS: f64 = 10.0;
/// Percent below which it does not stall any more.
const FLOWS: f64 = 5.0;
/// Percent of its memory that can still be given: with so much it is not the machine that stalls.
const PLENTY: f64 = 25.0;
/// Bytes a second read from swap: from so many on it swaps.
const SWAPS: f64 = (1 << 20) as f64;
/// Bytes a second below which it does not swap any more.
const SETTLED: f64 = SWAPS / 4.0;
/// It has ended when it has not been there for so long.
const QUIET: Duration = Duration::from_secs(5);

/// What the kernel tells.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Reading {
    /// `full avg10` of memory, percent; none where the kernel does not tell.
    pub memory_full: Option<f64>,
    /// `MemAvailable`, percent of all memory; none where the kernel does not tell.
    pub available: Option<f64>,
    /// Bytes a second read from swap since the last reading.
    pub swapped_in: f64,
}

/// Whether the machine stalls, from one reading to the next.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Stall {
    /// When a reading last said so, while it stalls.
    seen: Option<Instant>,
}

impl Stall {
    /// Why nobody is admitted at `now`, if so.
    pub fn judge(&mut self, reading: Reading, now: Instant) -> Option<String> {
        let full = reading.memory_full.unwrap_or(0.0);
        let (stalls, swaps) = match self.seen {
            None => (STALLS, SWAPS),
            Some(_) => (FLOWS, SETTLED),
        };
        let short = reading.available.is_none_or(|percent| percent < PLENTY);
        let why = if short && full >= stalls {
            format!(
                "this machine stalls: in {full:.0} % of the last 10 s everything waited for memory"
            )
        } else if reading.swapped_in >= swaps {
            let bytes = reading.swapped_in.max(0.0) as u64;
            format!(
                "this machine swaps: it reads {} a second back into memory",
                api::Size(bytes)
            )
        } else {
            match self.seen {
                Some(seen) if now.saturating_duration_since(seen) < QUIET => {
                    return Some("this machine stalled just now".to_owned());
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

    fn reading(memory_full: f64, swapped_in: f64) -> Reading {
        Reading {
            memory_full: Some(memory_full),
            available: Some(3.0),
            swapped_in,
        }
    }

    #[test]
    fn servants_that_wait_at_their_own_limits_are_not_the_machine() {
        for (available, stalls) in [(Some(80.0), false), (Some(24.9), true), (None, true)] {
            let of = Reading {
                available,
                ..reading(90.0, 0.0)
            };
            let why = Stall::default().judge(of, Instant::now());
            assert_eq!(why.is_some(), stalls, "{available:?}: {why:?}");
        }
    }

    #[test]
    fn it_begins_at_one_bound_and_ends_at_a_lower_one() {
        let began = Instant::now();
        let mut stall = Stall::default();
        for (second, of, expected) in [
            (0, reading(9.9, SWAPS - 1.0), None),
            (1, Reading::default(), None),
            (2, reading(12.4, 0.0), Some("stalls: in 12 %")),
            (3, reading(5.0, 0.0), Some("stalls: in 5 %")),
            (
                4,
                reading(4.9, SETTLED),
                Some("swaps: it reads 256K a second"),
            ),
            (5, reading(0.0, 0.0), Some("just now")),
            (8, reading(4.9, 0.0), Some("just now")),
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
            let mut stall = Stall::default();
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
