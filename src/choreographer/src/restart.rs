//! When a node that failed is started again: after a pause that doubles each time, and not for ever.

use std::time::Duration;

const FIRST_PAUSE: Duration = Duration::from_millis(500);
const LONGEST_PAUSE: Duration = Duration::from_secs(30);
/// A node that ran so long has recovered.
const RECOVERED: Duration = Duration::from_secs(60);
/// Failures in a row after which it is given up.
const ATTEMPTS: u32 = 6;

/// The failures of one node.
#[derive(Debug, Clone, Copy, Default)]
pub struct Backoff {
    failures: u32,
}

impl Backoff {
    /// The node failed after running for `ran`: how long to wait before it is started again, or none when it is
    /// given up.
    pub fn failed(&mut self, ran: Duration) -> Option<Duration> {
        if ran >= RECOVERED {
            self.failures = 0;
        }
        self.failures += 1;
        (self.failures <= ATTEMPTS)
            .then(|| LONGEST_PAUSE.min(FIRST_PAUSE * 2u32.pow(self.failures - 1)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_double_until_it_is_given_up() {
        let mut backoff = Backoff::default();
        let pauses: Vec<_> = std::iter::from_fn(|| backoff.failed(Duration::ZERO))
            .map(|pause| pause.as_millis())
            .collect();
        assert_eq!(pauses, [500, 1000, 2000, 4000, 8000, 16_000]);
    }

    #[test]
    fn a_node_that_ran_long_begins_anew() {
        let mut backoff = Backoff::default();
        while backoff.failed(Duration::ZERO).is_some() {}
        assert_eq!(backoff.failed(RECOVERED), Some(FIRST_PAUSE));
    }
}
