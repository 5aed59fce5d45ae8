//! Quantiles of durations in milliseconds.

use std::time::Duration;

/// Returns the quantile of durations in milliseconds.
pub(crate) fn quantile(times: &[Duration], fraction: f64) -> f64 {
    bench_report::quantile_seconds(times, fraction) * 1e3
}

/// Returns the median in milliseconds.
pub(crate) fn median(times: &[Duration]) -> f64 {
    quantile(times, 0.5)
}

/// Returns the maximum in milliseconds.
pub(crate) fn worst(times: &[Duration]) -> f64 {
    quantile(times, 1.0)
}
