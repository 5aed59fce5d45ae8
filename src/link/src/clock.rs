//! Clock offset estimation as in NTP (RFC 5905, section 8): among the most recent samples, the one with the shortest
//! round trip is used.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

/// Number of samples kept.
const SAMPLES: usize = 16;

/// Clock drift tolerated between two samples, in nanoseconds (5 ms). Samples whose offsets differ by more than this
/// plus half of both round trips contradict each other.
const DRIFT: i64 = 5_000_000;

static SHIFT: AtomicI64 = AtomicI64::new(0);

/// Returns the current time in nanoseconds since the Unix epoch.
pub fn now() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    let now = since.map_or(0, |since| i64::try_from(since.as_nanos()).unwrap_or(i64::MAX));
    now.saturating_add(SHIFT.load(Ordering::Relaxed))
}

/// Shifts this process's clock by the given number of nanoseconds. For tests in which both ends run on one machine.
pub fn shift_clock(nanoseconds: i64) {
    SHIFT.store(nanoseconds, Ordering::Relaxed);
}

/// The result of one ping and its pong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClockSample {
    /// Nanoseconds to add to the local clock to obtain the peer's clock.
    pub offset: i64,
    /// Round-trip time on the network in nanoseconds; the offset is accurate to half of it.
    pub delay: i64,
}

impl ClockSample {
    /// Computes a sample from the times at which the ping was sent and its pong received (local clock) and the ping was
    /// received and the pong sent (peer's clock).
    pub fn new(sent: i64, arrived: i64, left: i64, came: i64) -> Self {
        let there = arrived.saturating_sub(sent);
        let back = left.saturating_sub(came);
        Self { offset: there / 2 + back / 2, delay: there.saturating_sub(back).max(0) }
    }
}

/// The recent samples of the peer's clock.
#[derive(Debug, Clone, Default)]
pub struct ClockFilter {
    samples: VecDeque<ClockSample>,
}

impl ClockFilter {
    /// Adds a sample and returns the best one.
    pub fn add(&mut self, sample: ClockSample) -> ClockSample {
        let disagree = |best: ClockSample| {
            let apart = sample.offset.saturating_sub(best.offset).saturating_abs();
            apart > sample.delay / 2 + best.delay / 2 + DRIFT
        };
        // One of the clocks was stepped.
        if self.best().is_some_and(disagree) {
            self.samples.clear();
        }
        if self.samples.len() == SAMPLES {
            self.samples.pop_front();
        }
        self.samples.push_back(sample);
        self.best().unwrap_or(sample)
    }

    /// Returns the sample with the shortest round trip, or `None` before the first pong.
    pub fn best(&self) -> Option<ClockSample> {
        self.samples.iter().min_by_key(|sample| sample.delay).copied()
    }

    /// Returns the most recent round-trip time in nanoseconds.
    pub fn last_delay(&self) -> Option<i64> {
        self.samples.back().map(|sample| sample.delay)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    #[test]
    fn the_exchange_with_the_shortest_round_trip_determines_the_offset() {
        let mut clock = ClockFilter::default();
        // The peer is 250 ms ahead, with a delay of 3 ms each way.
        clock.add(ClockSample::new(0, 253 * MS, 254 * MS, 7 * MS));
        assert_eq!(clock.best(), Some(ClockSample { offset: 250 * MS, delay: 6 * MS }));
        // A slow forward path spoils a sample, which is then not used.
        clock.add(ClockSample::new(100 * MS, 450 * MS, 450 * MS, 203 * MS));
        assert_eq!(clock.best().unwrap().offset, 250 * MS);
        assert_eq!(clock.last_delay(), Some(103 * MS));
        for _ in 0..SAMPLES {
            clock.add(ClockSample { offset: 1, delay: 1000 * MS });
        }
        assert_eq!(clock.best().unwrap().offset, 1, "old samples are forgotten");
    }

    #[test]
    fn a_stepped_clock_is_accepted_at_once() {
        let mut clock = ClockFilter::default();
        let sample = |offset, delay| ClockSample { offset, delay };
        clock.add(sample(0, MS));
        clock.add(sample(20 * MS, 40 * MS));
        assert_eq!(clock.best().unwrap().offset, 0, "they agree");
        clock.add(sample(3_600_000 * MS, 40 * MS));
        assert_eq!(clock.best().unwrap().offset, 3_600_000 * MS);
    }
}
