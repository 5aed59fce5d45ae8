//! Forecasts how many robots will ask for a service, and how many containers must be made ahead for them.
//!
//! Arrivals are counted per interval and forecast by linear exponential smoothing (C. C. Holt, *Forecasting seasonals
//! and trends by exponentially weighted moving averages*, ONR memorandum 52, 1957; Int. J. Forecasting 20, 2004). A
//! pool of containers, each replaced a lead time after it was taken, is a loss system in which an arrival that finds no
//! container does without: its share is Erlang's B of the pool's size and of the arrivals in a lead time (W. Karush, *A
//! queuing model for an inventory problem*, Operations Research 5, 1957).

use std::time::{Duration, Instant};

/// Length of an interval in which arrivals are counted.
pub const INTERVAL: Duration = Duration::from_secs(10);
/// Weight of the last interval in the level.
const LEVEL: f64 = 0.5;
/// Weight of the last change of the level in the trend.
const TREND: f64 = 0.1;
/// Number of intervals without an arrival after which nothing is expected any more.
const MAX_EMPTY_INTERVALS: u32 = 30;
/// Maximum number of containers, whatever the arrivals.
const MAX_CONTAINERS: usize = 64;

/// Arrival statistics of one service's robots.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Arrivals {
    /// Start of the current interval.
    begun: Instant,
    count: u32,
    /// Smoothed arrivals per interval and their trend; `None` before the first interval is over.
    smoothed: Option<(f64, f64)>,
}

impl Arrivals {
    /// Starts without arrivals.
    pub fn new(now: Instant) -> Arrivals {
        Arrivals { begun: now, count: 0, smoothed: None }
    }

    /// Records the arrival of a robot.
    pub fn record_arrival(&mut self, now: Instant) {
        *self = self.advanced_to(now);
        self.count = self.count.saturating_add(1);
    }

    /// Returns the expected arrivals per second. A burst counts before its interval is over.
    pub fn expected_rate(&self, now: Instant) -> f64 {
        let of = self.advanced_to(now);
        let forecast = of.smoothed.map_or(0.0, |(level, trend)| level + trend);
        forecast.max(f64::from(of.count)) / INTERVAL.as_secs_f64()
    }

    /// Returns the statistics with all finished intervals smoothed.
    fn advanced_to(&self, now: Instant) -> Arrivals {
        let mut of = *self;
        let over = now.saturating_duration_since(of.begun).as_secs() / INTERVAL.as_secs();
        let over = u32::try_from(over).unwrap_or(u32::MAX);
        of.begun += INTERVAL * over;
        if over > MAX_EMPTY_INTERVALS {
            return Arrivals::new(of.begun);
        }
        for _ in 0..over {
            let count = f64::from(std::mem::take(&mut of.count));
            of.smoothed = Some(match of.smoothed {
                None => (count, 0.0),
                Some((level, trend)) => {
                    let next = (LEVEL * count + (1.0 - LEVEL) * (level + trend)).max(0.0);
                    (next, TREND * (next - level) + (1.0 - TREND) * trend)
                }
            });
        }
        of
    }
}

/// Returns Erlang's B: the fraction of arrivals that find none of `containers`, with `offered` arrivals per replacement
/// time.
pub fn erlang_b(containers: usize, offered: f64) -> f64 {
    (1..=containers).fold(1.0, |loss, n| offered * loss / (n as f64 + offered * loss))
}

/// Returns the fewest containers with which at most `share` of the arrivals find none.
pub fn containers_needed(offered: f64, share: f64) -> usize {
    (0..MAX_CONTAINERS).find(|n| erlang_b(*n, offered) <= share).unwrap_or(MAX_CONTAINERS)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Returns the forecast after intervals with these numbers of arrivals.
    fn forecast_after(counts: &[u32]) -> f64 {
        let begun = Instant::now();
        let mut arrivals = Arrivals::new(begun);
        for (interval, count) in counts.iter().enumerate() {
            for _ in 0..*count {
                arrivals.record_arrival(begun + INTERVAL * interval as u32);
            }
        }
        arrivals.expected_rate(begun + INTERVAL * counts.len() as u32) * INTERVAL.as_secs_f64()
    }

    #[test]
    fn what_comes_is_expected_from_what_came() {
        for (counts, expected) in [
            (&[] as &[u32], 0.0),
            (&[4], 4.0),
            (&[4, 4, 4], 4.0),
            // Level 4, then 6, trend 0.2: Holt's formulas by hand.
            (&[4, 8], 6.2),
            (&[4, 0], 1.8),
        ] {
            let is = forecast_after(counts);
            assert!((is - expected).abs() < 1e-9, "{counts:?}: {is}");
        }
        let begun = Instant::now();
        let mut burst = Arrivals::new(begun);
        (0..9).for_each(|_| burst.record_arrival(begun));
        assert!((burst.expected_rate(begun) - 0.9).abs() < 1e-9, "at once");
        let later = begun + INTERVAL * (MAX_EMPTY_INTERVALS + 1);
        assert_eq!(burst.expected_rate(later), 0.0);
    }

    /// Values from tables of Erlang's B.
    #[test]
    fn the_loss_is_erlangs() {
        for (containers, offered, expected) in
            [(0, 2.0, 1.0), (1, 1.0, 0.5), (2, 1.0, 0.2), (5, 3.0, 0.1101), (10, 5.0, 0.0184)]
        {
            let is = erlang_b(containers, offered);
            assert!((is - expected).abs() < 5e-5, "{containers} {offered}: {is}");
        }
        assert_eq!(containers_needed(0.0, 0.05), 1);
        assert_eq!(containers_needed(0.0, 1.0), 0);
        assert_eq!(containers_needed(1.0, 0.2), 2);
        assert_eq!(containers_needed(5.0, 0.02), 10);
        assert_eq!(containers_needed(1e9, 0.02), MAX_CONTAINERS);
    }

    proptest! {
        #[test]
        fn nothing_is_expected_that_makes_no_sense(
            counts in prop::collection::vec(0u32..50, 0..60),
            quiet in 0u32..90,
        ) {
            let most = counts.iter().copied().max().unwrap_or(0);
            let mut counts = counts;
            let busy = forecast_after(&counts);
            prop_assert!(busy >= 0.0 && busy.is_finite());
            prop_assert!(busy <= f64::from(most) * 2.0, "a trend is no explosion: {busy}");
            counts.extend(std::iter::repeat_n(0, quiet as usize));
            if quiet > MAX_EMPTY_INTERVALS {
                prop_assert_eq!(forecast_after(&counts), 0.0);
            }
        }

        #[test]
        fn more_containers_lose_less_and_more_robots_need_more(
            offered in 0.0f64..40.0,
            more in 0.0f64..10.0,
            containers in 0usize..40,
            share in 0.001f64..0.5,
        ) {
            prop_assert!(erlang_b(containers + 1, offered) <= erlang_b(containers, offered));
            let need = super::containers_needed(offered, share);
            prop_assert!(super::containers_needed(offered + more, share) >= need);
            prop_assert!(need == MAX_CONTAINERS || erlang_b(need, offered) <= share);
            prop_assert!(need == 0 || erlang_b(need - 1, offered) > share, "one too many");
        }
    }
}
