//! Descriptive statistics: means, deviations, intervals, and linear regression.

use std::iter::repeat_n;

use bench_report::{quantile, quantile_of_sorted, sort_values};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};

/// Resamples of a bootstrap.
const RESAMPLES: usize = 2000;

/// Arithmetic mean.
pub fn mean(values: &[f64]) -> Option<f64> {
    let sum: f64 = values.iter().sum();
    (!values.is_empty() && !sum.is_nan()).then(|| sum / values.len() as f64)
}

/// Standard deviation of a sample: the sum of squares is divided by n − 1 (Bessel's correction). `None` for fewer than
/// two values.
pub fn standard_deviation(values: &[f64]) -> Option<f64> {
    let mean = mean(values).filter(|mean| mean.is_finite())?;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    (values.len() > 1).then(|| (squares / (values.len() - 1) as f64).sqrt())
}

/// Confidence interval of the median, low and high, by the percentile bootstrap (Efron and Tibshirani, "An Introduction
/// to the Bootstrap", 1993, chapter 13). `confidence` is between 0 and 1, such as 0.95. The same values give the same
/// interval.
pub fn median_interval(values: &[f64], confidence: f64) -> Option<(f64, f64)> {
    let values = sort_values(values)?;
    let mut random = StdRng::seed_from_u64(0);
    let mut medians = Vec::with_capacity(RESAMPLES);
    for _ in 0..RESAMPLES {
        let mut drawn = vec![0; values.len()];
        for _ in 0..values.len() {
            drawn[random.random_range(0..values.len())] += 1;
        }
        let times = values.iter().zip(drawn);
        let resample: Vec<f64> = times.flat_map(|(value, times)| repeat_n(*value, times)).collect();
        medians.push(quantile_of_sorted(&resample, 0.5)?);
    }
    let outside = (1.0 - confidence) / 2.0;
    Some((quantile(&medians, outside)?, quantile(&medians, 1.0 - outside)?))
}

/// A straight line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FittedLine {
    /// Change of y per unit of x.
    pub slope: f64,
    /// y at x = 0.
    pub intercept: f64,
}

/// Fits a line through (x, y) by least squares of vertical distances. `None` unless there are two different x.
pub fn least_squares(points: &[(f64, f64)]) -> Option<FittedLine> {
    let of = |which: fn(&(f64, f64)) -> f64| mean(&points.iter().map(which).collect::<Vec<_>>());
    let (x, y) = (of(|point| point.0)?, of(|point| point.1)?);
    let sum =
        |term: &dyn Fn(f64, f64) -> f64| -> f64 { points.iter().map(|point| term(point.0 - x, point.1 - y)).sum() };
    let (xx, xy) = (sum(&|dx, _| dx * dx), sum(&|dx, dy| dx * dy));
    (xx > 0.0 && xy.is_finite()).then(|| FittedLine { slope: xy / xx, intercept: y - xy / xx * x })
}

/// Root mean square difference of pairs, such as (predicted, measured), in their unit.
pub fn root_mean_square_error(pairs: &[(f64, f64)]) -> Option<f64> {
    let squares: Vec<f64> = pairs.iter().map(|pair| (pair.0 - pair.1).powi(2)).collect();
    mean(&squares).map(f64::sqrt)
}

#[cfg(test)]
mod tests {
    use super::super::assert_near;
    use super::*;

    #[test]
    fn means_and_deviations() {
        // 2, 4, 4, 4, 5, 5, 7, 9: mean 5, sum of squares 32.
        let values = [2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0];
        assert_eq!(mean(&values), Some(5.0));
        assert_near(standard_deviation(&values).expect("values"), (32.0f64 / 7.0).sqrt());
        assert_eq!(mean(&[]), None);
        assert_eq!(mean(&[1.0, f64::NAN]), None);
        assert_eq!(standard_deviation(&[1.0]), None);
        assert_eq!(standard_deviation(&[1.0, f64::INFINITY]), None);
    }

    /// For the median of 1…100 the interval by order statistics (binomial) is from the 40th to the 61st value.
    #[test]
    fn the_medians_interval_is_that_of_order_statistics() {
        let values: Vec<f64> = (1..=100).map(f64::from).collect();
        let (low, high) = median_interval(&values, 0.95).expect("values");
        assert!((38.0..=43.0).contains(&low), "{low}");
        assert!((58.0..=63.0).contains(&high), "{high}");
        assert_eq!(median_interval(&values, 0.95), Some((low, high)));
        assert_eq!(median_interval(&[3.0, 3.0], 0.95), Some((3.0, 3.0)));
        assert_eq!(median_interval(&[], 0.95), None);
    }

    #[test]
    fn a_line_is_fitted() {
        // Means 2 and 4: Σdx² = 2, Σdx·dy = 3.
        let line = least_squares(&[(1.0, 2.0), (2.0, 5.0), (3.0, 5.0)]).expect("two x");
        assert_near(line.slope, 1.5);
        assert_near(line.intercept, 1.0);
        assert_eq!(least_squares(&[(1.0, 2.0), (1.0, 3.0)]), None);
        assert_eq!(least_squares(&[]), None);
        let level = least_squares(&[(0.0, 3.0), (1.0, 3.0)]).expect("two x");
        assert_eq!((level.slope, level.intercept), (0.0, 3.0));
    }

    #[test]
    fn errors_are_squared() {
        // Differences 3 and −4: √(25 / 2).
        let error = root_mean_square_error(&[(5.0, 2.0), (1.0, 5.0)]).expect("pairs");
        assert_near(error, 12.5f64.sqrt());
        assert_eq!(root_mean_square_error(&[]), None);
    }
}
