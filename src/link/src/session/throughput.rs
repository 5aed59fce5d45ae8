//! How fast the link is, from what the peer says has come.

use tokio::time::Instant;

/// So many measurements make a first estimate.
const FIRST_RATES: usize = 3;
/// The weight of a new measurement.
const NEWEST: f64 = 0.25;
/// Reports that come nearer to each other are one measurement, seconds: after a packet that was lost they come together.
const SHORTEST: f64 = 0.001;
/// A measurement counts as so many times the estimate at the most: what had piled up somewhere was not carried that fast.
const AT_ONCE: f64 = 2.0;

/// Bytes per second that the link carried when it had to.
#[derive(Debug, Default)]
pub(super) struct Throughput {
    known: Option<f64>,
    first: Vec<f64>,
    before: Option<Counters>,
}

/// What the peer said of how much had come, and how things stood then.
#[derive(Debug, Clone, Copy)]
pub(super) struct Counters {
    pub(super) at: Instant,
    /// So much had come.
    pub(super) bytes: u64,
    /// How much had been sent.
    pub(super) sent: u64,
    /// Nothing more waited to be sent.
    pub(super) idle: bool,
}

impl Throughput {
    /// The estimate; none before the link had something to carry.
    pub(super) fn known(&self) -> Option<f64> {
        self.known
    }

    /// Another connection: what was counters on the last one measures nothing.
    pub(super) fn reconnect(&mut self) {
        self.before = None;
    }

    /// Takes in what was counters; the new estimate, if it changes.
    pub(super) fn report(&mut self, counters: Counters) -> Option<f64> {
        let before = *self.before.get_or_insert(counters);
        let seconds = counters.at.duration_since(before.at).as_secs_f64();
        if seconds < SHORTEST {
            return None;
        }
        self.before = Some(counters);
        let rate = counters.bytes.saturating_sub(before.bytes) as f64 / seconds;
        // With nothing to send a link is not slow: all of it had been sent by then, or there was more all the time.
        let busy = before.sent >= counters.bytes || (!counters.idle && !before.idle);
        let counts = busy && counters.bytes > before.bytes;
        let quicker = self.known.is_some_and(|known| rate > known);
        (counts || quicker).then(|| self.measure(rate)).flatten()
    }

    /// The link carried so many bytes per second for a while. What disturbs a measurement makes it smaller, so the
    /// first ones count by the greatest among them.
    fn measure(&mut self, rate: f64) -> Option<f64> {
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
        let mut throughput = Throughput::default();
        let start = Instant::now();
        let mut counters = |seconds: u64, bytes: u64, sent: u64, idle: bool| {
            let at = start + Duration::from_secs(seconds);
            throughput.report(Counters {
                at,
                bytes,
                sent,
                idle,
            })
        };
        // There was always more: 100 bytes per second, disturbed once.
        assert_eq!(counters(0, 0, 1000, false), None);
        assert_eq!(counters(1, 100, 1000, false), None);
        assert_eq!(counters(2, 150, 1000, false), None);
        assert_eq!(counters(3, 250, 1000, false), Some(100.0));
        // Little was to be sent: that tells nothing.
        assert_eq!(counters(9, 1000, 1000, true), Some(106.25));
        assert_eq!(counters(19, 1001, 1001, true), None);
        // Another connection begins anew.
        throughput.reconnect();
        let at = start + Duration::from_secs(20);
        let first = Counters {
            at,
            bytes: 5000,
            sent: 5000,
            idle: false,
        };
        assert_eq!(throughput.report(first), None);
        assert_eq!(throughput.known(), Some(106.25));
    }

    #[test]
    fn what_piled_up_behind_a_lost_packet_does_not_make_a_link_fast() {
        let mut throughput = Throughput::default();
        let start = Instant::now();
        let mut bytes = 0;
        let mut report = |throughput: &mut Throughput, micros: u64| {
            bytes += 64_000;
            throughput.report(Counters {
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
        // A packet is lost: seven are told of at once, then it goes on.
        for number in 0..7 {
            report(&mut throughput, 217_000 + number * 2);
        }
        report(&mut throughput, 230_000);
        let known = throughput.known().expect("it was measured");
        assert!((4e6..8e6).contains(&known), "{known}");
        // One that has become fast is known to be so soon.
        for number in 0..20 {
            report(&mut throughput, 231_100 + number * 1_100);
        }
        let known = throughput.known().expect("it was measured");
        assert!((40e6..60e6).contains(&known), "{known}");
    }
}
