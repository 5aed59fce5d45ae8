//! Quantile sketch of response times in little memory, accurate to two percent of the value (C. Masson, J. E. Rim and
//! H. K. Lee, *DDSketch: a fast and fully-mergeable quantile sketch with relative-error guarantees*, VLDB 2019).

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

const ACCURACY: f64 = 0.02;
const GAMMA: f64 = (1.0 + ACCURACY) / (1.0 - ACCURACY);
/// Range of distinguishable values, in milliseconds: robots are not trusted, and the number of buckets is bounded.
const RANGE: (f64, f64) = (1e-3, 1e9);

/// Counts of values by their logarithm.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Sketch {
    buckets: BTreeMap<i32, u64>,
}

fn bucket(value: f64) -> i32 {
    // NaN is nonsense and counts as the maximum.
    let value = if value.is_nan() { RANGE.1 } else { value };
    (value.clamp(RANGE.0, RANGE.1).ln() / GAMMA.ln()).ceil() as i32
}

impl Sketch {
    /// Counts a value.
    pub fn record(&mut self, value: f64) {
        *self.buckets.entry(bucket(value)).or_default() += 1;
    }

    /// Returns the number of values.
    pub fn count(&self) -> u64 {
        self.buckets.values().sum()
    }

    /// Returns the quantile at this fraction.
    pub fn quantile(&self, part: f64) -> Option<f64> {
        let rank = (part * self.count().checked_sub(1)? as f64).floor() as u64;
        let mut before = 0;
        let (at, _) = self.buckets.iter().find(|(_, count)| {
            before += **count;
            before > rank
        })?;
        Some(2.0 * GAMMA.powi(*at) / (GAMMA + 1.0))
    }

    /// Returns the number of values greater than `value`, within the accuracy.
    pub fn count_above(&self, value: f64) -> u64 {
        let after = bucket(value) + 1;
        self.buckets.range(after..).map(|(_, count)| count).sum()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn quantiles_are_within_two_percent(
            values in prop::collection::vec(0.01f64..1e6, 1..300),
            part in 0.0f64..=1.0,
        ) {
            let mut sketch = Sketch::default();
            values.iter().for_each(|value| sketch.record(*value));
            let mut sorted = values.clone();
            sorted.sort_by(f64::total_cmp);
            let exact = sorted[(part * (sorted.len() - 1) as f64).floor() as usize];
            let is = sketch.quantile(part).expect("there are some");
            prop_assert!((is - exact).abs() <= ACCURACY * exact * 1.0001, "{is} {exact}");
            prop_assert_eq!(sketch.count(), values.len() as u64);
            let sure = values.iter().filter(|value| **value > exact * GAMMA).count() as u64;
            let most = values.iter().filter(|value| **value > exact).count() as u64;
            prop_assert!((sure..=most).contains(&sketch.count_above(exact)));
        }
    }

    #[test]
    fn what_makes_no_sense_costs_no_memory() {
        let mut sketch = Sketch::default();
        assert_eq!(sketch.quantile(0.5), None);
        for value in [f64::NAN, f64::INFINITY, -1.0, 0.0, 1e300] {
            (0..100).for_each(|_| sketch.record(value));
        }
        assert_eq!((sketch.count(), sketch.buckets.len()), (500, 2));
    }
}
