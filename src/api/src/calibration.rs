//! Calibrations: `POST /api/v1/services/NAME/calibration?options=JSON` replays recorded requests against a servant of the
//! service at several limits. The body is the recording (rosbag 2.0), or pictures (PNG files, one behind the other), or
//! empty where a robot's own requests are taken. The answer is a stream of [`CalibrationEvent`]s. Times are in milliseconds.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::dictionary::Row;
use crate::problem::Problem;
use crate::size::Size;
use crate::trial::Fed;

/// What to measure, and with what.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct CalibrationOptions {
    /// What the requests are taken from.
    pub source: Source,
    /// The robot whose requests are taken, with `live`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub robot: Option<String>,
    /// Seconds for which they are taken, at most; 20 by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seconds: Option<f64>,
    /// Bytes of them that are taken, at most; 256M by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bytes: Option<Size>,
    /// Limits to measure at, in cores; without, a geometric ladder that ends where more cores make nothing faster.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub cpus: Vec<f64>,
    /// Requests at each limit, at most; 40 by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub requests: Option<usize>,
    /// Requests a second, instead of the recording's own pace.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rate: Option<f64>,
    /// The next request follows the last answer at once. Pictures have no other pace without a rate.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub fast: bool,
    /// The input whose messages are the requests; without, the recording's first topic that the service has an input for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub input: Option<String>,
    /// What robots' networks and stubs add to each request; with `live` it is what the robot measured, unless given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub network: Option<f64>,
    /// Auxiliary parameters of the rows, such as `image=640x480`.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub aux: BTreeMap<String, String>,
    /// Memory that the servant may use from its start on, as another machine would have it, whatever robots may ask for at most; without, the service's own limit.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory: Option<Size>,
    /// It is measured once, at the cores that the service was pushed with, else at one core, at most those of the machine.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub own: bool,
    /// The time of each request is told as well.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub times: bool,
    /// Seconds for which the servant stays behind the last limit, at most: then whoever asked can use it over their own network,
    /// and ends it by not reading on.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keep: Option<f64>,
}

/// Kind of the [`Problem`] of a servant that needed more memory than it may use, before anything was measured.
pub const OUT_OF_MEMORY: &str = "urn:cloudroid:out-of-memory";

/// What the requests of a calibration are taken from.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Source {
    /// A recording in the body.
    #[default]
    Bag,
    /// Pictures in the body.
    Frames,
    /// What a connected robot sends now.
    Live,
}

/// One line of the answer. The last is `done` or `error`; a stream that ends otherwise was cut.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum CalibrationEvent {
    /// A new step begins.
    Step {
        /// What is done now.
        title: String,
    },
    /// One limit has been measured.
    Measured {
        /// What was measured.
        point: Point,
        /// Time of each answered request, in their order, where that was asked for.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        times: Vec<f64>,
    },
    /// All limits have been measured, and the servant stays at the last of them for as long as was asked for.
    Kept {
        /// Its id.
        servant: String,
        /// What was found.
        calibration: Box<Calibration>,
    },
    /// All limits have been measured; nothing has been written.
    Done {
        /// What was found.
        calibration: Box<Calibration>,
    },
    /// Not measured.
    Error {
        /// The reason, and what to do.
        problem: Problem,
    },
}

/// What a calibration found.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Calibration {
    /// The service.
    pub service: String,
    /// The revision that was measured.
    pub revision: u64,
    /// What was published to it, over all limits.
    pub inputs: Vec<Fed>,
    /// Topics of the recording that the service has no input for.
    pub unused: Vec<String>,
    /// Size of the largest request.
    pub largest: Size,
    /// Requests a second of the recording; none where each followed the answer before it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pace: Option<f64>,
    /// What networks and stubs add to each request: of the robot whose requests were taken, or as it was given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub network: Option<TimeSpread>,
    /// What was measured at each limit, fewest cores first.
    pub points: Vec<Point>,
    /// Why no more limits were measured.
    pub ended: String,
    /// The most memory that was in use at any limit, without files that the kernel may drop.
    pub memory_peak: Size,
    /// Percent that the rows' memory lies above it.
    pub memory_margin: u64,
    /// Rows that it proposes, cheapest first: with its limits, each is the response time that 95 % of the requests met, rounded
    /// up to two digits.
    pub rows: Vec<Row>,
}

/// What was measured at one limit.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Point {
    /// The limit, in cores.
    pub cpus: f64,
    /// Requests.
    pub requests: usize,
    /// Of them were answered.
    pub answered: usize,
    /// From the request's arrival at the node to the answer; none where nothing was answered.
    pub compute: Option<TimeSpread>,
    /// Processor time that a request took, on average.
    pub running: f64,
    /// Time for which the limit held a request up, on average, summed over the servant's cores.
    pub throttled: f64,
    /// Requests a second.
    pub rate: f64,
    /// The most memory that was in use, without files that the kernel may drop.
    pub memory: Size,
}

/// Spread of a time, in milliseconds (nearest ranks).
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
    /// Of times in any order (nearest ranks); none of none.
    pub fn of(mut times: Vec<f64>) -> Option<TimeSpread> {
        times.sort_by(f64::total_cmp);
        let rank = |percent| qos::nearest_rank(&times, percent);
        Some(TimeSpread {
            p50: rank(50)?,
            p95: rank(95)?,
            max: rank(100)?,
        })
    }
}

/// A time in milliseconds with two digits, never less than it was.
pub fn rounded_up(milliseconds: f64) -> f64 {
    // A time of nothing is none that anybody could ask for.
    let milliseconds = milliseconds.max(1e-3);
    let digit = 10f64.powf(milliseconds.log10().floor() - 1.0);
    let up = (milliseconds / digit).ceil() * digit;
    // What powers of ten left behind the digits.
    (up * 1e6).round() / 1e6
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spreads_are_nearest_ranks_in_any_order() {
        let times = (1..=40).rev().map(f64::from).collect();
        let spread = TimeSpread::of(times).expect("times");
        assert_eq!((spread.p50, spread.p95, spread.max), (20.0, 38.0, 40.0));
        assert_eq!(TimeSpread::of(vec![7.0]).map(|one| one.p95), Some(7.0));
        assert_eq!(TimeSpread::of(Vec::new()), None);
    }

    #[test]
    fn options_say_only_what_was_asked_for_and_name_what_is_unknown() {
        let options = CalibrationOptions {
            source: Source::Live,
            robot: Some("r1".into()),
            ..CalibrationOptions::default()
        };
        let text = serde_json::to_string(&options).expect("plain data");
        assert_eq!(text, r#"{"source":"live","robot":"r1"}"#);
        let refused = serde_json::from_str::<CalibrationOptions>(r#"{"limits":[1]}"#);
        let refused = refused.expect_err("unknown").to_string();
        assert!(refused.contains("`limits`"), "{refused}");
    }
}
