//! Times as figures.

use std::time::Duration;

/// The middle one.
pub(crate) fn median(times: &[Duration]) -> f64 {
    part(times, 0.5)
}

/// The longest.
pub(crate) fn worst(times: &[Duration]) -> f64 {
    part(times, 1.0)
}

/// The one that this fraction of them stays below.
pub(crate) fn part(times: &[Duration], fraction: f64) -> f64 {
    bench_report::quantile(times, fraction).map_or(f64::NAN, |time| time.as_secs_f64() * 1e3)
}
