//! Calibrations: `POST /api/v1/services/NAME/calibration?options=JSON` replays recorded requests against a servant of
//! the service at several CPU limits. The body is a recording (rosbag 2.0), a concatenation of PNG images, or empty if
//! a robot's live requests are used. The response is a stream of [`CalibrationEvent`]s. Times are in milliseconds.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::dictionary::Row;
use crate::problem::Problem;
use crate::size::Size;
use crate::trial::Fed;

/// Options of a calibration.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct CalibrationOptions {
    /// Source of the requests.
    pub source: Source,
    /// Robot whose requests are captured; only with source `live`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub robot: Option<String>,
    /// Maximum time to capture live requests, in seconds (default: 20).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seconds: Option<f64>,
    /// Maximum size of the captured live requests, in bytes (default: 256M).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bytes: Option<Size>,
    /// CPU limits to measure at, in cores (default: a geometric series that ends when more cores do not reduce the
    /// response time).
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub cpus: Vec<f64>,
    /// Maximum number of requests at each limit (default: 40).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub requests: Option<usize>,
    /// Requests per second (default: the rate of the recording).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rate: Option<f64>,
    /// Send each request as soon as the previous one is answered. This is the default for images if no rate is given.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub fast: bool,
    /// Input topic whose messages are the requests (default: the first topic of the recording that matches an input of
    /// the service).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub input: Option<String>,
    /// Milliseconds that the network and the stub add to each request (default with source `live`: the value measured
    /// by the robot).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub network: Option<f64>,
    /// Auxiliary parameters of the resulting rows, such as `image=640x480`.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub aux: BTreeMap<String, String>,
    /// Memory limit of the servant from its start, to emulate another machine; may exceed the cap on what robots may
    /// request (default: the service's own memory limit).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory: Option<Size>,
    /// Measure once only, at the CPU limit that the service was pushed with (default: 1 core), capped at the machine's
    /// number of cores.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub own: bool,
    /// Report the response time of each request as well.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub times: bool,
    /// Maximum time, in seconds, to keep the servant running at the last limit after the measurement, so that the
    /// caller can use it over its own network. The caller ends it by closing the stream.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keep: Option<f64>,
}

/// Kind of the [`Problem`] reported if the servant exceeded its memory limit before anything was measured.
pub const OUT_OF_MEMORY: &str = "urn:cloudroid:out-of-memory";

/// Source of the requests of a calibration.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Source {
    /// A recording in the request body.
    #[default]
    Bag,
    /// Images in the request body.
    Frames,
    /// Live messages of a connected robot.
    Live,
}

/// One line of the response. The last line is `done` or `error`; a stream that ends otherwise was truncated.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum CalibrationEvent {
    /// A new step begins.
    Step {
        /// Title of the step.
        title: String,
    },
    /// The measurement at one limit is complete.
    Measured {
        /// Result of the measurement.
        point: Point,
        /// Response time of each answered request, in order; only if requested.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        times: Vec<f64>,
    },
    /// All limits have been measured; the servant keeps running at the last limit for the requested time.
    Kept {
        /// Id of the servant.
        servant: String,
        /// Result of the calibration.
        calibration: Box<Calibration>,
    },
    /// All limits have been measured. The proposed rows have not been written.
    Done {
        /// Result of the calibration.
        calibration: Box<Calibration>,
    },
    /// The calibration failed.
    Error {
        /// Reason of the failure, and the next step.
        problem: Problem,
    },
}

/// Result of a calibration.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Calibration {
    /// Name of the service.
    pub service: String,
    /// Revision that was measured.
    pub revision: u64,
    /// Messages published to the service, over all limits.
    pub inputs: Vec<Fed>,
    /// Topics of the recording that match no input of the service.
    pub unused: Vec<String>,
    /// Size of the largest request.
    pub largest: Size,
    /// Requests per second of the recording; absent if each request was sent as soon as the previous one was answered.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pace: Option<f64>,
    /// Time that the network and the stub add to each request, as measured on the robot or as given in the options.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub network: Option<TimeSpread>,
    /// Measurements, in ascending order of the CPU limit.
    pub points: Vec<Point>,
    /// Reason why no further limits were measured.
    pub ended: String,
    /// Peak memory over all limits, not counting reclaimable page cache.
    pub memory_peak: Size,
    /// Margin of the rows' memory limit over the peak, in percent.
    pub memory_margin: u64,
    /// Proposed rows, cheapest first. The value of each row is the 95th percentile of the response time under its
    /// limits, rounded up to two significant digits.
    pub rows: Vec<Row>,
}

/// Measurement at one CPU limit.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Point {
    /// CPU limit in cores.
    pub cpus: f64,
    /// Number of requests sent.
    pub requests: usize,
    /// Number of requests that were answered.
    pub answered: usize,
    /// Time from the arrival of a request at the node to its answer; absent if nothing was answered.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub compute: Option<TimeSpread>,
    /// Mean CPU time per request.
    pub running: f64,
    /// Mean time per request for which the CPU limit throttled the servant, summed over its cores.
    pub throttled: f64,
    /// Requests per second.
    pub rate: f64,
    /// Peak memory, not counting reclaimable page cache.
    pub memory: Size,
}

/// Distribution of a time, in milliseconds (nearest-rank percentiles).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct TimeSpread {
    /// Median.
    pub p50: f64,
    /// 95th percentile.
    pub p95: f64,
    /// Maximum.
    pub max: f64,
}

impl TimeSpread {
    /// Computes the distribution of samples in any order (nearest-rank percentiles); `None` if there are no samples.
    pub fn from_samples(mut times: Vec<f64>) -> Option<TimeSpread> {
        times.sort_by(f64::total_cmp);
        let rank = |percent| qos::nearest_rank(&times, percent);
        Some(TimeSpread { p50: rank(50)?, p95: rank(95)?, max: rank(100)? })
    }
}

/// Rounds a time in milliseconds up to two significant digits.
pub fn round_up_to_two_digits(milliseconds: f64) -> f64 {
    // A response time of zero could not be requested by anybody.
    let milliseconds = milliseconds.max(1e-3);
    let digit = 10f64.powf(milliseconds.log10().floor() - 1.0);
    let up = (milliseconds / digit).ceil() * digit;
    // Removes the floating-point error of the powers of ten.
    (up * 1e6).round() / 1e6
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spreads_are_nearest_ranks_in_any_order() {
        let times = (1..=40).rev().map(f64::from).collect();
        let spread = TimeSpread::from_samples(times).expect("times");
        assert_eq!((spread.p50, spread.p95, spread.max), (20.0, 38.0, 40.0));
        assert_eq!(TimeSpread::from_samples(vec![7.0]).map(|one| one.p95), Some(7.0));
        assert_eq!(TimeSpread::from_samples(Vec::new()), None);
    }

    #[test]
    fn options_say_only_what_was_asked_for_and_name_what_is_unknown() {
        let options =
            CalibrationOptions { source: Source::Live, robot: Some("r1".into()), ..CalibrationOptions::default() };
        let text = serde_json::to_string(&options).expect("plain data");
        assert_eq!(text, r#"{"source":"live","robot":"r1"}"#);
        let refused = serde_json::from_str::<CalibrationOptions>(r#"{"limits":[1]}"#);
        let refused = refused.expect_err("unknown").to_string();
        assert!(refused.contains("`limits`"), "{refused}");
    }
}
