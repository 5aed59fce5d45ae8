//! Quantiles, for the benchmarks and the evaluation.

use std::time::Duration;

/// Returns the quantile of `values` at a fraction `0.0..=1.0`, linearly interpolated between two values: type 7 of
/// Hyndman and Fan, "Sample Quantiles in Statistical Packages", The American Statistician 50 (1996). Returns `None` for
/// an empty slice, or if a value is NaN; infinite values keep their rank.
pub fn quantile(values: &[f64], fraction: f64) -> Option<f64> {
    quantile_of_sorted(&sort_values(values)?, fraction)
}

/// Returns the quantile at one half.
pub fn median(values: &[f64]) -> Option<f64> {
    quantile(values, 0.5)
}

/// Returns the quantile of durations in seconds; NaN for an empty slice.
pub fn quantile_seconds(times: &[Duration], fraction: f64) -> f64 {
    let seconds: Vec<f64> = times.iter().map(Duration::as_secs_f64).collect();
    quantile(&seconds, fraction).unwrap_or(f64::NAN)
}

/// Returns the values in ascending order; `None` if one is NaN.
pub fn sort_values(values: &[f64]) -> Option<Vec<f64>> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    (!sorted.iter().any(|value| value.is_nan())).then_some(sorted)
}

/// Returns the [`quantile`] of values in ascending order, none of which is NaN.
pub fn quantile_of_sorted(sorted: &[f64], fraction: f64) -> Option<f64> {
    let last = sorted.len().checked_sub(1)?;
    let place = fraction.clamp(0.0, 1.0) * last as f64;
    let lower = *sorted.get(place.floor() as usize)?;
    let upper = *sorted.get(place.ceil() as usize)?;
    // The difference of two infinite values would be NaN.
    Some(if lower == upper || place.fract() == 0.0 { lower } else { lower + (upper - lower) * place.fract() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_interpolated() {
        let values = [40.0, 10.0, 30.0, 20.0];
        assert_eq!(median(&values), Some(25.0));
        // (4 − 1) · 0.9 = 2.7: seven tenths of the way from 30 to 40.
        let late = quantile(&values, 0.9).expect("values");
        assert!((late - 37.0).abs() < 1e-9, "{late}");
        assert_eq!(quantile(&values, 0.0), Some(10.0));
        assert_eq!(quantile(&values, 1.0), Some(40.0));
        assert_eq!(quantile(&[], 0.5), None);
        assert_eq!(median(&[1.0, f64::NAN]), None);
        let times = [1, 3].map(Duration::from_secs);
        assert_eq!(quantile_seconds(&times, 0.5), 2.0);
        assert!(quantile_seconds(&[], 0.5).is_nan());
    }

    #[test]
    fn unanswered_requests_keep_their_place_in_quantiles() {
        let values = [1.0, f64::INFINITY, 2.0, f64::INFINITY];
        assert_eq!(quantile(&values, 0.9), Some(f64::INFINITY));
        assert_eq!(quantile(&values, 1.0 / 3.0), Some(2.0));
        assert_eq!(median(&values), Some(f64::INFINITY));
    }
}
