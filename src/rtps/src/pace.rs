//! How fast receivers are sent to whose buffers cannot be seen: those of other machines. Such a buffer holds some 200 kB by default,
//! and what does not fit is lost without a word; a network is often quicker than whoever reads. So a large sample is spread over a
//! part of the time until the next one, which is known by how much was sent lately: whoever can read what is sent can read it then. A reliable receiver that asks for much
//! again is sent to more slowly.

#![forbid(unsafe_code)]

use std::collections::HashMap;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

/// Bytes that are sent at once after a pause: a part of a default buffer, in which the kernel counts some two for each.
const BURST: f64 = 48.0 * 1024.0;
/// So much faster than what was sent lately, on the average, a receiver is sent to: the half of the time is left for repairs.
const AHEAD: f64 = 2.0;
/// Bytes per second that a receiver is sent at least, so that single samples do not take long: 0.4 Gbit/s.
const LEAST: f64 = 50e6;
/// Bytes per second that no receiver is sent more of.
const MOST: f64 = 1.25e9;
/// Over which time it is averaged.
const LATELY: f64 = 0.5;
/// Where more than this part is sent again, the pace is too high.
const LOST: f64 = 0.05;
/// How often that is judged, by which factors the pace follows, and what part of it is left in the worst case.
const JUDGED: Duration = Duration::from_millis(50);
const SLOWER: f64 = 0.7;
const FASTER: f64 = 1.1;
const SLOWEST: f64 = 0.25;
/// Receivers to which nothing was sent for so long are forgotten.
const FORGOTTEN: Duration = Duration::from_secs(10);

/// What one receiver is sent.
#[derive(Debug, Clone, Copy)]
struct Bucket {
    /// Bytes that may be sent now; below zero they are owed.
    tokens: f64,
    /// Bytes per second that were sent lately.
    sent: f64,
    /// Those among them that had been lost before.
    again: f64,
    /// What part of the usual pace it keeps up with.
    part: f64,
    judged: Instant,
    counted: Instant,
}

impl Bucket {
    fn rate(&self) -> f64 {
        (self.sent * AHEAD).clamp(LEAST, MOST) * self.part
    }

    /// Slows down while much is lost, and becomes faster again while little is.
    fn judge(&mut self, now: Instant) {
        if now.saturating_duration_since(self.judged) < JUDGED {
            return;
        }
        self.judged = now;
        let change = match self.again > self.sent * LOST {
            true => SLOWER,
            false => FASTER,
        };
        self.part = (self.part * change).clamp(SLOWEST, 1.0);
    }

    fn pass(&mut self, now: Instant) {
        let passed = now.saturating_duration_since(self.counted).as_secs_f64();
        self.tokens = (self.tokens + passed * self.rate()).min(BURST);
        self.sent *= (-passed / LATELY).exp();
        self.again *= (-passed / (LATELY / 5.0)).exp();
        self.judge(now);
        self.counted = now;
    }
}

/// The pace of all such receivers.
#[derive(Debug, Default)]
pub(crate) struct Pace {
    buckets: HashMap<SocketAddr, Bucket>,
}

impl Pace {
    /// Whether a datagram of so many bytes may be sent now, and is counted as sent; else how long that takes. `again` tells that the
    /// receiver had asked for it.
    pub fn room(
        &mut self,
        now: Instant,
        to: SocketAddr,
        length: usize,
        again: bool,
    ) -> Result<(), Duration> {
        let bucket = self.buckets.entry(to).or_insert(Bucket {
            tokens: BURST,
            sent: 0.0,
            again: 0.0,
            part: 1.0,
            judged: now,
            counted: now,
        });
        bucket.pass(now);
        if bucket.tokens < 0.0 {
            return Err(Duration::from_secs_f64(-bucket.tokens / bucket.rate()));
        }
        bucket.tokens -= length as f64;
        let rate = length as f64 / LATELY;
        bucket.sent += rate;
        bucket.again += if again { rate } else { 0.0 };
        Ok(())
    }

    /// Forgets receivers that nobody sends to.
    pub fn tidy(&mut self, now: Instant) {
        self.buckets
            .retain(|_, bucket| now.saturating_duration_since(bucket.counted) < FORGOTTEN);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TO: ([u8; 4], u16) = ([10, 0, 0, 7], 7411);

    /// How long a sample takes that is ready at `now`, in datagrams of 16 kB.
    fn send(pace: &mut Pace, now: &mut Instant, bytes: usize) -> Duration {
        let begun = *now;
        for _ in 0..bytes.div_ceil(16_000) {
            while let Err(wait) = pace.room(*now, TO.into(), 16_000, false) {
                *now += wait.max(Duration::from_nanos(1));
            }
        }
        *now - begun
    }

    #[test]
    fn a_large_sample_is_spread_and_a_small_one_is_not() {
        let (mut pace, mut now) = (Pace::default(), Instant::now());
        assert_eq!(send(&mut pace, &mut now, 48_000), Duration::ZERO);
        now += Duration::from_secs(1);
        let alone = send(&mut pace, &mut now, 900_000);
        assert!(
            (Duration::from_millis(14)..Duration::from_millis(20)).contains(&alone),
            "{alone:?}"
        );
    }

    #[test]
    fn what_is_sent_steadily_never_takes_longer_than_the_time_until_the_next() {
        for (bytes, hertz) in [
            (900_000, 30),
            (6_000_000, 30),
            (6_000_000, 60),
            (100_000, 100),
        ] {
            let (mut pace, mut now) = (Pace::default(), Instant::now());
            let mut next = now;
            let mut last = Duration::ZERO;
            for _ in 0..3 * hertz {
                now = now.max(next);
                next += Duration::from_secs(1) / hertz;
                send(&mut pace, &mut now, bytes);
                last = now.saturating_duration_since(next);
            }
            assert_eq!(last, Duration::ZERO, "{bytes} bytes at {hertz} Hz");
        }
    }

    #[test]
    fn a_receiver_that_loses_much_is_sent_to_more_slowly_for_a_while() {
        let (mut pace, mut now) = (Pace::default(), Instant::now());
        let before = send(&mut pace, &mut now, 900_000);
        for _ in 0..200 {
            let _ = pace.room(now, TO.into(), 16_000, true);
            now += Duration::from_millis(5);
        }
        let slow = send(&mut pace, &mut now, 900_000);
        assert!(slow > before * 3, "{before:?}, then {slow:?}");
        for _ in 0..1000 {
            let _ = pace.room(now, TO.into(), 16_000, false);
            now += Duration::from_millis(10);
        }
        let after = send(&mut pace, &mut now, 900_000);
        assert!(after < before * 2, "{before:?}, then {after:?}");
    }

    #[test]
    fn receivers_are_forgotten() {
        let (mut pace, now) = (Pace::default(), Instant::now());
        let _ = pace.room(now, TO.into(), 100, false);
        pace.tidy(now + FORGOTTEN);
        assert!(pace.buckets.is_empty());
    }
}
