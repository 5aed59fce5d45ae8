//! The satisfaction algorithm: how content the robot is with the cloud, as one real number Q.

use std::time::Duration;

/// The cap of Q in thresholds, where an SLA gives none.
pub const DEFAULT_CAP: f64 = 4.0;

/// Q and what moves it.
///
/// After each request, T being the cloud's completion time: T ≤ T_desire adds 2, T ≤ T_max adds 1, anything later
/// halves Q. Below the threshold Q_t the local original is wanted, above it is not; at Q_t nothing changes.
///
/// Q stays below a cap, 4·Q_t unless the SLA says otherwise. Without it a long good time would delay the switch: a surplus
/// of s needs log2(s) late requests to be forgotten. Below 2^n·Q_t any n late requests in a row bring Q below Q_t.
#[derive(Debug, Clone, PartialEq)]
pub struct Satisfaction {
    q: f64,
    threshold: f64,
    /// The greatest value that Q takes.
    most: f64,
    /// From here on nothing points to trouble.
    full: f64,
}

/// What one request did to Q.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// T ≤ T_desire.
    Desired,
    /// T_desire < T ≤ T_max.
    Accepted,
    /// T > T_max, or no answer by then.
    Late,
}

impl Satisfaction {
    /// Starts at `initial`, or right below `cap` where `initial` is more. All are positive, `cap` is greater than
    /// `threshold` and may be infinite (an [`Sla`](crate::Sla) has checked that).
    pub fn new(initial: f64, threshold: f64, cap: f64) -> Self {
        let most = below(cap);
        Self {
            q: initial.min(most),
            threshold,
            most,
            full: most.min(below(DEFAULT_CAP * threshold)),
        }
    }

    /// Counts one request that the cloud completed after `t`; `None` where it had not by T_max.
    pub fn observe(&mut self, t: Option<Duration>, t_desire: Duration, t_max: Duration) -> Step {
        let step = match t {
            Some(t) if t <= t_desire => Step::Desired,
            Some(t) if t <= t_max => Step::Accepted,
            _ => Step::Late,
        };
        self.q = match step {
            Step::Desired => (self.q + 2.0).min(self.most),
            Step::Accepted => (self.q + 1.0).min(self.most),
            Step::Late => self.q / 2.0,
        };
        step
    }

    /// Satisfaction now.
    pub fn q(&self) -> f64 {
        self.q
    }

    /// Q_t.
    pub fn threshold(&self) -> f64 {
        self.threshold
    }

    /// Q < Q_t: the local original is to be started.
    pub fn wants_local(&self) -> bool {
        self.q < self.threshold
    }

    /// Q > Q_t: the local original is to be stopped.
    pub fn wants_cloud_alone(&self) -> bool {
        self.q > self.threshold
    }

    /// Q is as high as it gets, or at the default cap where the cap is higher.
    pub fn is_full(&self) -> bool {
        self.q >= self.full
    }
}

/// The greatest finite number below `x`, which is positive (`f64::next_down` is newer than this crate's minimum Rust).
pub(crate) fn below(x: f64) -> f64 {
    f64::from_bits(x.to_bits() - 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const DESIRE: Duration = Duration::from_millis(100);
    const MAX: Duration = Duration::from_millis(300);

    fn ms(ms: u64) -> Option<Duration> {
        Some(Duration::from_millis(ms))
    }

    #[test]
    fn each_request_moves_q_as_published() {
        let mut satisfaction = Satisfaction::new(8.0, 4.0, 16.0);
        assert_eq!(satisfaction.observe(ms(100), DESIRE, MAX), Step::Desired);
        assert_eq!(satisfaction.q(), 10.0);
        assert_eq!(satisfaction.observe(ms(101), DESIRE, MAX), Step::Accepted);
        assert_eq!(satisfaction.q(), 11.0);
        assert_eq!(satisfaction.observe(ms(300), DESIRE, MAX), Step::Accepted);
        assert_eq!(satisfaction.q(), 12.0);
        assert_eq!(satisfaction.observe(ms(301), DESIRE, MAX), Step::Late);
        assert_eq!(satisfaction.q(), 6.0);
        assert_eq!(satisfaction.observe(None, DESIRE, MAX), Step::Late);
        assert_eq!(satisfaction.q(), 3.0);
        assert!(satisfaction.wants_local());
        assert_eq!(satisfaction.observe(None, DESIRE, MAX), Step::Late);
        assert_eq!(satisfaction.q(), 1.5);
    }

    #[test]
    fn at_the_threshold_nothing_changes() {
        let satisfaction = Satisfaction::new(4.0, 4.0, 16.0);
        assert!(!satisfaction.wants_local());
        assert!(!satisfaction.wants_cloud_alone());
    }

    proptest! {
        #[test]
        fn q_stays_within_its_bounds(
            initial in 0.001f64..1e9, threshold in 0.001f64..1e6, factor in 1.01f64..100.0,
            times in prop::collection::vec(prop::option::of(0u64..500), 0..300)
        ) {
            let mut satisfaction = Satisfaction::new(initial, threshold, factor * threshold);
            for t in times {
                let before = satisfaction.q();
                let step = satisfaction.observe(t.map(Duration::from_millis), DESIRE, MAX);
                let after = satisfaction.q();
                prop_assert!((0.0..factor * threshold).contains(&after), "Q {after}");
                match step {
                    Step::Late => prop_assert_eq!(after, before / 2.0),
                    _ => prop_assert!(after >= before),
                }
            }
        }

        #[test]
        fn two_late_requests_in_a_row_always_suffice(
            threshold in 0.001f64..1e6, good in 0usize..1000
        ) {
            let mut satisfaction = Satisfaction::new(threshold, threshold, DEFAULT_CAP * threshold);
            for _ in 0..good {
                satisfaction.observe(ms(1), DESIRE, MAX);
            }
            satisfaction.observe(None, DESIRE, MAX);
            satisfaction.observe(None, DESIRE, MAX);
            prop_assert!(satisfaction.wants_local(), "Q {} of {}", satisfaction.q(), threshold);
        }
    }
}
