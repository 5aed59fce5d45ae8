//! The satisfaction algorithm: rates the cloud by one real number Q.

use std::time::Duration;

/// Default cap of Q, as a multiple of the threshold.
pub const DEFAULT_CAP: f64 = 4.0;

/// The satisfaction Q and its parameters.
///
/// After each request, with the cloud's completion time T: T ≤ T_desire adds 2, T ≤ T_max adds 1, anything later halves
/// Q. Below the threshold Q_t the local original is wanted, above it is not; at Q_t nothing changes.
///
/// Q stays below a cap, 4·Q_t unless the SLA sets another. Without it a long good period would delay the switch: a
/// surplus of s needs log2(s) late requests to decay. With a cap of 2^n·Q_t any n late requests in a row bring Q below
/// Q_t.
#[derive(Debug, Clone, PartialEq)]
pub struct Satisfaction {
    q: f64,
    threshold: f64,
    /// Maximum of Q.
    most: f64,
    /// Q at or above which the service counts as free of trouble.
    full: f64,
}

/// Rating of one request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ResponseGrade {
    /// T ≤ T_desire.
    Desired,
    /// T_desire < T ≤ T_max.
    Accepted,
    /// T > T_max, or no answer by T_max.
    Late,
}

impl Satisfaction {
    /// Creates the state with Q = `initial`, or right below `cap` if `initial` is larger. All are positive, `cap` is
    /// greater than `threshold` and may be infinite ([`QosSla`](crate::QosSla) has checked that).
    pub fn new(initial: f64, threshold: f64, cap: f64) -> Self {
        let most = next_below(cap);
        Self { q: initial.min(most), threshold, most, full: most.min(next_below(DEFAULT_CAP * threshold)) }
    }

    /// Counts one request that the cloud completed after `t`; `None` if it was not completed by T_max.
    pub fn observe(&mut self, t: Option<Duration>, t_desire: Duration, t_max: Duration) -> ResponseGrade {
        let step = match t {
            Some(t) if t <= t_desire => ResponseGrade::Desired,
            Some(t) if t <= t_max => ResponseGrade::Accepted,
            _ => ResponseGrade::Late,
        };
        self.q = match step {
            ResponseGrade::Desired => (self.q + 2.0).min(self.most),
            ResponseGrade::Accepted => (self.q + 1.0).min(self.most),
            ResponseGrade::Late => self.q / 2.0,
        };
        step
    }

    /// Returns the current Q.
    pub fn q(&self) -> f64 {
        self.q
    }

    /// Returns the threshold Q_t.
    pub fn threshold(&self) -> f64 {
        self.threshold
    }

    /// Returns true if Q < Q_t: the local original is to be started.
    pub fn wants_local(&self) -> bool {
        self.q < self.threshold
    }

    /// Returns true if Q > Q_t: the local original is to be stopped.
    pub fn wants_cloud_alone(&self) -> bool {
        self.q > self.threshold
    }

    /// Returns true if Q is at its maximum, or at the default cap if the cap is higher.
    pub fn is_full(&self) -> bool {
        self.q >= self.full
    }
}

/// Returns the greatest finite number below `x`, which is positive (`f64::next_down` is newer than this crate's minimum
/// Rust).
pub(crate) fn next_below(x: f64) -> f64 {
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
        assert_eq!(satisfaction.observe(ms(100), DESIRE, MAX), ResponseGrade::Desired);
        assert_eq!(satisfaction.q(), 10.0);
        assert_eq!(satisfaction.observe(ms(101), DESIRE, MAX), ResponseGrade::Accepted);
        assert_eq!(satisfaction.q(), 11.0);
        assert_eq!(satisfaction.observe(ms(300), DESIRE, MAX), ResponseGrade::Accepted);
        assert_eq!(satisfaction.q(), 12.0);
        assert_eq!(satisfaction.observe(ms(301), DESIRE, MAX), ResponseGrade::Late);
        assert_eq!(satisfaction.q(), 6.0);
        assert_eq!(satisfaction.observe(None, DESIRE, MAX), ResponseGrade::Late);
        assert_eq!(satisfaction.q(), 3.0);
        assert!(satisfaction.wants_local());
        assert_eq!(satisfaction.observe(None, DESIRE, MAX), ResponseGrade::Late);
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
                    ResponseGrade::Late => prop_assert_eq!(after, before / 2.0),
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
