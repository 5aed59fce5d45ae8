//! The phases of a request's time.

use std::collections::VecDeque;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::quantile::nearest_rank;

/// Number of samples kept: enough for a 99th percentile, 12 kB in all.
const KEPT: usize = 512;

/// The phases of one request, up to the cloud's answer. `up` and `down` are the link's own times, without queues.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Phases {
    /// On the robot: taking the message from the application and encoding it.
    pub serialise: Duration,
    /// Robot → server.
    pub up: Duration,
    /// Waiting in the queues of the robot and the server.
    pub queue: Duration,
    /// Computation in the servant's node.
    pub compute: Duration,
    /// Server → robot, decoding, and delivery to the application.
    pub down: Duration,
}

impl Phases {
    /// Returns the phases with their names, in order.
    pub fn by_name(&self) -> [(&'static str, Duration); 5] {
        [
            ("serialise", self.serialise),
            ("up", self.up),
            ("queue", self.queue),
            ("compute", self.compute),
            ("down", self.down),
        ]
    }

    /// Returns the sum of the phases, the request response time.
    pub fn total(&self) -> Duration {
        self.by_name().iter().map(|(_, time)| *time).sum()
    }
}

/// Quantiles of one phase, in milliseconds.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Quantiles {
    /// `serialise`, `up`, `queue`, `compute`, `down` or `total`.
    pub phase: String,
    /// Median.
    pub p50: f64,
    /// 90th percentile.
    pub p90: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Maximum.
    pub max: f64,
}

/// The phases of the last requests; older ones are dropped, which bounds memory and keeps the figures recent.
#[derive(Debug, Clone, Default)]
pub struct PhaseHistory {
    kept: VecDeque<[u32; 6]>,
}

impl PhaseHistory {
    /// Records the phases of one request.
    pub fn record(&mut self, phases: &Phases) {
        if self.kept.len() == KEPT {
            self.kept.pop_front();
        }
        let microseconds = |time: Duration| u32::try_from(time.as_micros()).unwrap_or(u32::MAX);
        let [a, b, c, d, e] = phases.by_name().map(|(_, time)| microseconds(time));
        self.kept.push_back([a, b, c, d, e, microseconds(phases.total())]);
    }

    /// Returns the number of recorded requests.
    pub fn len(&self) -> usize {
        self.kept.len()
    }

    /// Returns true if nothing was recorded.
    pub fn is_empty(&self) -> bool {
        self.kept.is_empty()
    }

    /// Returns the quantiles (nearest rank) of each phase and of their sum; empty if nothing was recorded.
    pub fn quantiles(&self) -> Vec<Quantiles> {
        if self.is_empty() {
            return Vec::new();
        }
        let names = Phases::default().by_name().map(|(name, _)| name);
        let names = names.into_iter().chain(["total"]).enumerate();
        let of = |(index, name): (usize, &str)| {
            let mut sorted: Vec<u32> = self.kept.iter().map(|sample| sample[index]).collect();
            sorted.sort_unstable();
            let rank = |percent| nearest_rank(&sorted, percent).map_or(0.0, f64::from) / 1000.0;
            Quantiles { phase: name.to_owned(), p50: rank(50), p90: rank(90), p99: rank(99), max: rank(100) }
        };
        names.map(of).collect()
    }

    /// Returns the phase that takes most of the time, with its share of the total; `None` if nothing was recorded.
    pub fn dominant(&self) -> Option<(&'static str, f64)> {
        let mut sums = [0u64; 6];
        for sample in &self.kept {
            for (sum, part) in sums.iter_mut().zip(sample) {
                *sum += u64::from(*part);
            }
        }
        let names = Phases::default().by_name().map(|(name, _)| name);
        let (name, sum) = names.into_iter().zip(sums).max_by_key(|(_, sum)| *sum)?;
        (sums[5] > 0).then(|| (name, sum as f64 / sums[5] as f64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn phases(compute: u64) -> Phases {
        let ms = Duration::from_millis;
        Phases { serialise: ms(1), up: ms(2), queue: ms(0), compute: ms(compute), down: ms(3) }
    }

    #[test]
    fn quantiles_are_nearest_ranks() {
        let mut book = PhaseHistory::default();
        assert!(book.quantiles().is_empty());
        assert_eq!(book.dominant(), None);
        for compute in 1..=100 {
            book.record(&phases(compute));
        }
        let all = book.quantiles();
        let compute = &all[3];
        assert_eq!(compute.phase, "compute");
        assert_eq!((compute.p50, compute.p90), (50.0, 90.0));
        assert_eq!((compute.p99, compute.max), (99.0, 100.0));
        assert_eq!(all[5].phase, "total");
        assert_eq!(all[5].max, 106.0);
        assert_eq!(book.dominant().unwrap().0, "compute");
    }

    #[test]
    fn old_requests_are_forgotten() {
        let mut book = PhaseHistory::default();
        for _ in 0..10_000 {
            book.record(&phases(500));
        }
        for _ in 0..KEPT {
            book.record(&phases(1));
        }
        assert_eq!(book.len(), KEPT);
        assert_eq!(book.quantiles()[3].max, 1.0);
    }
}
