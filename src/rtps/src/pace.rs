//! Pacing for receivers whose buffers cannot be queried, on other machines. Such a buffer holds about 200 kB by
//! default, and the excess is lost silently; a network is often faster than the reader. Therefore a large sample is
//! spread over a part of the time until the next one, which is estimated from the recent send rate: a receiver that
//! keeps up with the average then keeps up at any time. A reliable receiver that requests much again is sent to more
//! slowly.

#![forbid(unsafe_code)]

use std::collections::HashMap;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

/// Burst size in bytes after a pause: a part of a default buffer, in which the kernel counts about two bytes for each.
const BURST: f64 = 48.0 * 1024.0;
/// Ratio of the pace to the recent average rate: half of the time is left for repairs.
const AHEAD: f64 = 2.0;
/// Minimum pace in bytes per second, so that single samples do not take long: 0.4 Gbit/s.
const MIN_PACE: f64 = 50e6;
/// Maximum pace in bytes per second.
const MAX_PACE: f64 = 1.25e9;
/// Averaging time in seconds.
const LATELY: f64 = 0.5;
/// Fraction of repeated bytes above which the pace is too high.
const MAX_REPEATED_SHARE: f64 = 0.05;
/// Interval and factors of adjusting the pace, and its lowest fraction.
const ADJUST_INTERVAL: Duration = Duration::from_millis(50);
const SLOWER: f64 = 0.7;
const FASTER: f64 = 1.1;
const SLOWEST: f64 = 0.25;
/// Time after which idle receivers are forgotten.
const RECEIVER_EXPIRY: Duration = Duration::from_secs(10);

/// Token bucket of one receiver.
#[derive(Debug, Clone, Copy)]
struct TokenBucket {
    /// Bytes that may be sent now; negative values are a debt.
    tokens: f64,
    /// Recent send rate in bytes per second.
    sent: f64,
    /// Part of this rate that was sent again.
    again: f64,
    /// Fraction of the regular pace that the receiver keeps up with.
    part: f64,
    judged: Instant,
    counted: Instant,
}

impl TokenBucket {
    fn rate(&self) -> f64 {
        (self.sent * AHEAD).clamp(MIN_PACE, MAX_PACE) * self.part
    }

    /// Slows down while much is lost, and recovers while little is.
    fn adjust_rate(&mut self, now: Instant) {
        if now.saturating_duration_since(self.judged) < ADJUST_INTERVAL {
            return;
        }
        self.judged = now;
        let change = if self.again > self.sent * MAX_REPEATED_SHARE { SLOWER } else { FASTER };
        self.part = (self.part * change).clamp(SLOWEST, 1.0);
    }

    fn advance(&mut self, now: Instant) {
        let passed = now.saturating_duration_since(self.counted).as_secs_f64();
        self.tokens = (self.tokens + passed * self.rate()).min(BURST);
        self.sent *= (-passed / LATELY).exp();
        self.again *= (-passed / (LATELY / 5.0)).exp();
        self.adjust_rate(now);
        self.counted = now;
    }
}

/// The token buckets of all receivers.
#[derive(Debug, Default)]
pub(crate) struct Pacer {
    buckets: HashMap<SocketAddr, TokenBucket>,
}

impl Pacer {
    /// Returns `Ok` if a datagram of this length may be sent now, and counts it as sent; otherwise the time to wait.
    /// `again`: the receiver has requested it again.
    pub fn try_reserve(&mut self, now: Instant, to: SocketAddr, length: usize, again: bool) -> Result<(), Duration> {
        let bucket = self.buckets.entry(to).or_insert(TokenBucket {
            tokens: BURST,
            sent: 0.0,
            again: 0.0,
            part: 1.0,
            judged: now,
            counted: now,
        });
        bucket.advance(now);
        if bucket.tokens < 0.0 {
            return Err(Duration::from_secs_f64(-bucket.tokens / bucket.rate()));
        }
        bucket.tokens -= length as f64;
        let rate = length as f64 / LATELY;
        bucket.sent += rate;
        bucket.again += if again { rate } else { 0.0 };
        Ok(())
    }

    /// Forgets receivers to which nothing was sent recently.
    pub fn remove_expired(&mut self, now: Instant) {
        self.buckets.retain(|_, bucket| now.saturating_duration_since(bucket.counted) < RECEIVER_EXPIRY);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TO: ([u8; 4], u16) = ([10, 0, 0, 7], 7411);

    /// Returns the time it takes to send a sample that is ready at `now`, in datagrams of 16 kB.
    fn send(pace: &mut Pacer, now: &mut Instant, bytes: usize) -> Duration {
        let begun = *now;
        for _ in 0..bytes.div_ceil(16_000) {
            while let Err(wait) = pace.try_reserve(*now, TO.into(), 16_000, false) {
                *now += wait.max(Duration::from_nanos(1));
            }
        }
        *now - begun
    }

    #[test]
    fn a_large_sample_is_spread_and_a_small_one_is_not() {
        let (mut pace, mut now) = (Pacer::default(), Instant::now());
        assert_eq!(send(&mut pace, &mut now, 48_000), Duration::ZERO);
        now += Duration::from_secs(1);
        let alone = send(&mut pace, &mut now, 900_000);
        assert!((Duration::from_millis(14)..Duration::from_millis(20)).contains(&alone), "{alone:?}");
    }

    #[test]
    fn what_is_sent_steadily_never_takes_longer_than_the_time_until_the_next() {
        for (bytes, hertz) in [(900_000, 30), (6_000_000, 30), (6_000_000, 60), (100_000, 100)] {
            let (mut pace, mut now) = (Pacer::default(), Instant::now());
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
        let (mut pace, mut now) = (Pacer::default(), Instant::now());
        let before = send(&mut pace, &mut now, 900_000);
        for _ in 0..200 {
            let _ = pace.try_reserve(now, TO.into(), 16_000, true);
            now += Duration::from_millis(5);
        }
        let slow = send(&mut pace, &mut now, 900_000);
        assert!(slow > before * 3, "{before:?}, then {slow:?}");
        for _ in 0..1000 {
            let _ = pace.try_reserve(now, TO.into(), 16_000, false);
            now += Duration::from_millis(10);
        }
        let after = send(&mut pace, &mut now, 900_000);
        assert!(after < before * 2, "{before:?}, then {after:?}");
    }

    #[test]
    fn receivers_are_forgotten() {
        let (mut pace, now) = (Pacer::default(), Instant::now());
        let _ = pace.try_reserve(now, TO.into(), 100, false);
        pace.remove_expired(now + RECEIVER_EXPIRY);
        assert!(pace.buckets.is_empty());
    }
}
