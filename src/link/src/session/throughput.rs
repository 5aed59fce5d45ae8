//! How fast the link is, from what the peer says has come.

use tokio::time::Instant;

/// So many measurements make a first estimate.
const FIRST_RATES: usize = 3;
/// The weight of a new measurement.
const NEWEST: f64 = 0.25;

/// Bytes per second that the link carried when it had to.
#[derive(Debug, Default)]
pub(super) struct Throughput {
    known: Option<f64>,
    first: Vec<f64>,
    before: Option<Told>,
}

/// What the peer said of how much had come, and how things stood then.
#[derive(Debug, Clone, Copy)]
pub(super) struct Told {
    pub(super) at: Instant,
    /// So much had come.
    pub(super) bytes: u64,
    /// How much had been sent.
    pub(super) sent: u64,
    /// That was all there was.
    pub(super) idle: bool,
}

impl Throughput {
    /// The estimate; none before the link had something to carry.
    pub(super) fn known(&self) -> Option<f64> {
        self.known
    }

    /// Another connection: what was told on the last one measures nothing.
    pub(super) fn reconnect(&mut self) {
        self.before = None;
    }

    /// Takes in what was told; the new estimate, if it changes.
    pub(super) fn told(&mut self, told: Told) -> Option<f64> {
        let before = self.before.replace(told)?;
        let seconds = told.at.duration_since(before.at).as_secs_f64();
        let rate = told.bytes.saturating_sub(before.bytes) as f64 / seconds.max(1e-6);
        // With nothing to send a link is not slow: all of it had been sent by then, or there was more all the time.
        let busy = before.sent >= told.bytes || (!told.idle && !before.idle);
        let counts = busy && seconds > 0.001 && told.bytes > before.bytes;
        let quicker = self.known.is_some_and(|known| rate > known);
        (counts || quicker).then(|| self.measure(rate)).flatten()
    }

    /// The link carried so many bytes per second for a while. What disturbs a measurement makes it smaller, so the
    /// first ones count by the greatest among them.
    fn measure(&mut self, rate: f64) -> Option<f64> {
        match self.known {
            Some(known) => self.known = Some(known + NEWEST * (rate - known)),
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
        let mut told = |seconds: u64, bytes: u64, sent: u64, idle: bool| {
            let at = start + Duration::from_secs(seconds);
            throughput.told(Told {
                at,
                bytes,
                sent,
                idle,
            })
        };
        // There was always more: 100 bytes per second, disturbed once.
        assert_eq!(told(0, 0, 1000, false), None);
        assert_eq!(told(1, 100, 1000, false), None);
        assert_eq!(told(2, 150, 1000, false), None);
        assert_eq!(told(3, 250, 1000, false), Some(100.0));
        // Little was to be sent: that tells nothing.
        assert_eq!(told(9, 1000, 1000, true), Some(106.25));
        assert_eq!(told(19, 1001, 1001, true), None);
        // Another connection begins anew.
        throughput.reconnect();
        let at = start + Duration::from_secs(20);
        let first = Told {
            at,
            bytes: 5000,
            sent: 5000,
            idle: false,
        };
        assert_eq!(throughput.told(first), None);
        assert_eq!(throughput.known(), Some(106.25));
    }
}
