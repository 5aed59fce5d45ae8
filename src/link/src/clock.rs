//! The difference between two clocks, measured as NTP does (RFC 5905, section 8): of the last samples the one with
//! the shortest round trip is believed.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

/// Samples believed in.
const SAMPLES: usize = 16;

/// Exchanges disagree when they differ by more than their ways allow, and what clocks drift meanwhile: 5 ms.
const DRIFT: i64 = 5_000_000;

static SHIFT: AtomicI64 = AtomicI64::new(0);

/// Nanoseconds since 1970.
pub fn now() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    let now = since.map_or(0, |since| {
        i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
    });
    now.saturating_add(SHIFT.load(Ordering::Relaxed))
}

/// Makes this process's clock differ from the machine's by so many nanoseconds: for tests that have one machine only.
pub fn shift(nanoseconds: i64) {
    SHIFT.store(nanoseconds, Ordering::Relaxed);
}

/// One exchange.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sample {
    /// What must be added to our clock to have the peer's, in nanoseconds.
    pub offset: i64,
    /// Time on the way, both ways together, in nanoseconds: the offset is right within half of it.
    pub delay: i64,
}

impl Sample {
    /// From when a ping was sent and its pong came (our clock) and when the ping arrived and the pong left (the peer's).
    pub fn new(sent: i64, arrived: i64, left: i64, came: i64) -> Self {
        let there = arrived.saturating_sub(sent);
        let back = left.saturating_sub(came);
        Self {
            offset: there / 2 + back / 2,
            delay: there.saturating_sub(back).max(0),
        }
    }
}

/// What is known of the peer's clock.
#[derive(Debug, Clone, Default)]
pub struct Clock {
    samples: VecDeque<Sample>,
}

impl Clock {
    /// Takes in one exchange.
    pub fn add(&mut self, sample: Sample) {
        let disagree = |best: Sample| {
            let apart = sample.offset.saturating_sub(best.offset).saturating_abs();
            apart > sample.delay / 2 + best.delay / 2 + DRIFT
        };
        // One of the clocks was set.
        if self.best().is_some_and(disagree) {
            self.samples.clear();
        }
        if self.samples.len() == SAMPLES {
            self.samples.pop_front();
        }
        self.samples.push_back(sample);
    }

    /// The sample that is believed; none before the first pong.
    pub fn best(&self) -> Option<Sample> {
        self.samples
            .iter()
            .min_by_key(|sample| sample.delay)
            .copied()
    }

    /// The last round trip, in nanoseconds.
    pub fn last_delay(&self) -> Option<i64> {
        self.samples.back().map(|sample| sample.delay)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    #[test]
    fn the_quickest_exchange_tells_the_offset() {
        let mut clock = Clock::default();
        // The peer is 250 ms ahead; 3 ms each way.
        clock.add(Sample::new(0, 253 * MS, 254 * MS, 7 * MS));
        assert_eq!(
            clock.best(),
            Some(Sample {
                offset: 250 * MS,
                delay: 6 * MS
            })
        );
        // A slow way there spoils a sample, and nobody believes it.
        clock.add(Sample::new(100 * MS, 450 * MS, 450 * MS, 203 * MS));
        assert_eq!(clock.best().unwrap().offset, 250 * MS);
        assert_eq!(clock.last_delay(), Some(103 * MS));
        for _ in 0..SAMPLES {
            clock.add(Sample {
                offset: 1,
                delay: 1000 * MS,
            });
        }
        assert_eq!(clock.best().unwrap().offset, 1, "old samples are forgotten");
    }

    #[test]
    fn a_clock_that_was_set_is_believed_at_once() {
        let mut clock = Clock::default();
        let sample = |offset, delay| Sample { offset, delay };
        clock.add(sample(0, MS));
        clock.add(sample(20 * MS, 40 * MS));
        assert_eq!(clock.best().unwrap().offset, 0, "they agree");
        clock.add(sample(3_600_000 * MS, 40 * MS));
        assert_eq!(clock.best().unwrap().offset, 3_600_000 * MS);
    }
}
