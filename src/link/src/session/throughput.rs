//! Throughput estimation from the peer's acknowledgements.

use tokio::time::Instant;

/// Number of measurements for the first estimate.
const FIRST_RATES: usize = 3;
/// Weight of a new measurement.
const NEWEST: f64 = 0.25;
/// Minimum time in seconds between two measurements; after a lost packet, reports arrive in bursts.
const SHORTEST: f64 = 0.001;
/// Factor by which a measurement may exceed the estimate; more is a backlog that was delivered at once.
const AT_ONCE: f64 = 2.0;

/// Throughput of the link in bytes per second, measured while it is busy.
#[derive(Debug, Default)]
pub(super) struct ThroughputEstimator {
    known: Option<f64>,
    first: Vec<f64>,
    before: Option<Counters>,
}

/// An acknowledgement of the peer, and the send state at that time.
#[derive(Debug, Clone, Copy)]
pub(super) struct Counters {
    pub(super) at: Instant,
    /// Bytes received by the peer.
    pub(super) bytes: u64,
    /// Bytes sent.
    pub(super) sent: u64,
    /// True if the queue was empty.
    pub(super) idle: bool,
}

impl ThroughputEstimator {
    /// Returns the estimate, or `None` before the link was busy.
    pub(super) fn estimate(&self) -> Option<f64> {
        self.known
    }

    /// Starts anew on another connection: the counters of the last one are not comparable.
    pub(super) fn reconnect(&mut self) {
        self.before = None;
    }

    /// Adds counters and returns the new estimate, if it changes.
    pub(super) fn update(&mut self, counters: Counters) -> Option<f64> {
        let before = *self.before.get_or_insert(counters);
        let seconds = counters.at.duration_since(before.at).as_secs_f64();
        if seconds < SHORTEST {
            return None;
        }
        self.before = Some(counters);
        let rate = counters.bytes.saturating_sub(before.bytes) as f64 / seconds;
        // A link with nothing to send is not slow: everything had been sent by then, or there was more all the time.
        let busy = before.sent >= counters.bytes || (!counters.idle && !before.idle);
        let counts = busy && counters.bytes > before.bytes;
        let quicker = self.known.is_some_and(|known| rate > known);
        (counts || quicker).then(|| self.add_rate(rate)).flatten()
    }

    /// Adds a measured rate in bytes per second. Disturbances only reduce a measurement, so the first estimate is the
    /// maximum of the first ones.
    fn add_rate(&mut self, rate: f64) -> Option<f64> {
        match self.known {
            Some(known) => {
                let rate = rate.min(AT_ONCE * known);
                self.known = Some(known + NEWEST * (rate - known));
            }
            None => {
                self.first.push(rate);
                if self.first.len() < FIRST_RATES {
                    return None;
                }
                self.known = Some(self.first.drain(..).fold(0.0, f64::max));
            }
        }
        self.known
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_link_is_as_fast_as_it_was_when_it_had_to_be() {
        let mut throughput = ThroughputEstimator::default();
        let start = Instant::now();
        let mut counters = |seconds: u64, bytes: u64, sent: u64, idle: bool| {
            let at = start + Duration::from_secs(seconds);
            throughput.update(Counters { at, bytes, sent, idle })
        };
        // There was always more to send: 100 bytes per second, disturbed once.
        assert_eq!(counters(0, 0, 1000, false), None);
        assert_eq!(counters(1, 100, 1000, false), None);
        assert_eq!(counters(2, 150, 1000, false), None);
        assert_eq!(counters(3, 250, 1000, false), Some(100.0));
        // Little was sent, which shows nothing.
        assert_eq!(counters(9, 1000, 1000, true), Some(106.25));
        assert_eq!(counters(19, 1001, 1001, true), None);
        // Another connection starts anew.
        throughput.reconnect();
        let at = start + Duration::from_secs(20);
        let first = Counters { at, bytes: 5000, sent: 5000, idle: false };
        assert_eq!(throughput.update(first), None);
        assert_eq!(throughput.estimate(), Some(106.25));
    }

    #[test]
    fn what_piled_up_behind_a_lost_packet_does_not_make_a_link_fast() {
        let mut throughput = ThroughputEstimator::default();
        let start = Instant::now();
        let mut bytes = 0;
        let mut report = |throughput: &mut ThroughputEstimator, micros: u64| {
            bytes += 64_000;
            throughput.update(Counters {
                at: start + Duration::from_micros(micros),
                bytes,
                sent: u64::MAX,
                idle: false,
            })
        };
        // 64 kB every 13 ms, which is 4.9 MB/s.
        for number in 0..10 {
            report(&mut throughput, number * 13_000);
        }
        // A packet is lost: seven acknowledgements arrive at once, then it continues.
        for number in 0..7 {
            report(&mut throughput, 217_000 + number * 2);
        }
        report(&mut throughput, 230_000);
        let known = throughput.estimate().expect("it was measured");
        assert!((4e6..8e6).contains(&known), "{known}");
        // A link that has become fast is recognized soon.
        for number in 0..20 {
            report(&mut throughput, 231_100 + number * 1_100);
        }
        let known = throughput.estimate().expect("it was measured");
        assert!((40e6..60e6).contains(&known), "{known}");
    }
}
