//! Descriptive statistics: means, deviations, the spread of repeated runs, and linear regression.

use bench_report::sort_values;

use super::median;

/// The median of the runs of one measurement, with the lowest and the highest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spread {
    pub low: f64,
    pub median: f64,
    pub high: f64,
}

impl Spread {
    pub fn from_values(values: &[f64]) -> Option<Self> {
        let sorted = sort_values(values)?;
        Some(Self { low: *sorted.first()?, median: median(&sorted)?, high: *sorted.last()? })
    }

    /// Returns whether all runs exceed all of another measurement, so that the difference is more than chance.
    pub fn is_above(self, other: Self) -> bool {
        self.low > other.high
    }
}

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

/// A straight line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FittedLine {
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

    #[test]
    fn runs_have_a_median_and_a_spread() {
        let spread = Spread::from_values(&[3.0, 1.0, 2.0]).expect("values");
        assert_eq!((spread.low, spread.median, spread.high), (1.0, 2.0, 3.0));
        assert_eq!(Spread::from_values(&[]), None);
        let above = Spread::from_values(&[3.5, 9.0]).expect("values");
        assert!(above.is_above(spread) && !spread.is_above(above) && !spread.is_above(spread));
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
