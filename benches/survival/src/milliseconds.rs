//! Durations as figures in milliseconds.

use std::time::Duration;

/// Median.
pub(crate) fn median(times: &[Duration]) -> f64 {
    quantile(times, 0.5)
}

/// Maximum.
pub(crate) fn worst(times: &[Duration]) -> f64 {
    quantile(times, 1.0)
}

/// Quantile at `fraction`.
pub(crate) fn quantile(times: &[Duration], fraction: f64) -> f64 {
    bench_report::quantile(times, fraction).map_or(f64::NAN, |time| time.as_secs_f64() * 1e3)
}
