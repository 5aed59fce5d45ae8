//! Explains why a robot is slow, or is served by its local originals: `GET /api/v1/robots/NAME/explain`.

use serde::{Deserialize, Serialize};

use crate::event::Event;
use crate::servant::Servant;

/// Diagnosis of one robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Explanation {
    /// Name of the robot.
    pub robot: String,
    /// Causes found, most severe first; empty if nothing is wrong.
    pub causes: Vec<Cause>,
    /// Servants of the robot.
    pub servants: Vec<Served>,
    /// Latest events of the robot, oldest first.
    pub events: Vec<Event>,
}

/// A cause of slow or local service.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Cause {
    /// Severity of the cause.
    pub weight: Weight,
    /// Description of the cause, with figures.
    pub what: String,
    /// Suggested next step.
    pub next: String,
}

/// Severity of a cause.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Weight {
    /// Blocks the service entirely.
    Blocks,
    /// Increases the response time.
    Slows,
    /// Informational.
    Hint,
}

/// A servant of the robot, and the links to it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Served {
    /// The servant.
    pub servant: Servant,
    /// Fraction of the last sampling period in which the servant was throttled by its CPU limit, 0 to 1.
    pub throttled: f64,
    /// CPU usage in the last sampling period, in cores.
    pub cores: f64,
    /// Links, one for each node that a stub stands for.
    pub links: Vec<Link>,
}

/// Link of a node, and statistics of its latest requests. Times are in milliseconds.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Link {
    /// Name of the node.
    pub node: String,
    /// True if the connection is established and has not gone silent.
    pub up: bool,
    /// Latest round-trip time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub round_trip: Option<f64>,
    /// Offset of the robot's clock from this machine's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clock: Option<f64>,
    /// Measured downlink throughput in bytes per second, when the link was saturated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub throughput: Option<f64>,
    /// Number of messages dropped on either side.
    pub dropped: u64,
    /// Dropped messages by topic, place and reason, one sentence each.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub drops: Vec<String>,
    /// T_desire of the response time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub desire: Option<f64>,
    /// T_max of the response time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max: Option<f64>,
    /// Q threshold Q_t, if the robot states one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub threshold: Option<f64>,
    /// Lowest acceptable rate of an output in frames per second, if a rate is promised instead of a response time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frames_per_second: Option<f64>,
    /// Desired rate of the output, if it differs from the lowest acceptable one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub desired_frames_per_second: Option<f64>,
    /// Highest acceptable age of an output, if an age is promised instead of a response time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub age: Option<f64>,
    /// Desired age of the output, if it differs from the highest acceptable one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub desired_age: Option<f64>,
    /// If no response time is promised: time in seconds for which the link must be down before the local original takes
    /// over. Such links have no Q, and none of their requests counts as late.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fallback_after: Option<f64>,
    /// Q after the latest request.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub satisfaction: Option<f64>,
    /// Number of requests in the statistics.
    pub requests: usize,
    /// Number of these requests that exceeded T_max or were never answered by the cloud.
    pub late: usize,
    /// Number of these requests that were answered by the local original.
    pub local: usize,
    /// Response time of these requests by phase.
    pub phases: Vec<Part>,
    /// Phase in which late requests spent most of their time; absent if none of them was answered.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub late_in: Option<Part>,
    /// Trace id of the latest answered request whose trace is exported, preferably of a late one; absent if the daemon
    /// exports no traces.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trace: Option<String>,
    /// Number of messages that the robot discarded in the last minute because they were superseded or too old.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub unsent: u64,
    /// Number of recent stamped inputs delivered to the node.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub given: usize,
    /// Number of these inputs that the node skipped in favour of newer ones.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub left_out: usize,
    /// Inputs of the node that nobody on the robot publishes.
    pub unfed: Vec<String>,
    /// Services that the node looked up without success.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub unserved: Vec<String>,
    /// Nodes of the robot that cannot exchange messages with this node, with the reason, one sentence each.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub refused: Vec<String>,
    /// Other machines that are connected as the same robot.
    #[serde(default, alias = "twins")]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub duplicates: Vec<String>,
}

/// One phase of the response time, over the latest requests.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Part {
    /// Phase: `serialise`, `up`, `queue`, `compute`, `down` or `total`.
    pub name: String,
    /// Median.
    pub p50: f64,
    /// 90th percentile.
    pub p90: f64,
    /// Maximum.
    pub max: f64,
}

impl Part {
    /// Computes the statistics of samples in any order (nearest-rank percentiles), ignoring non-finite ones; `None` if
    /// none are left.
    pub fn from_samples(name: &str, mut times: Vec<f64>) -> Option<Part> {
        times.retain(|time| time.is_finite());
        times.sort_by(f64::total_cmp);
        let rank = |percent| qos::nearest_rank(&times, percent);
        Some(Part { name: name.to_owned(), p50: rank(50)?, p90: rank(90)?, max: rank(100)? })
    }
}

impl Link {
    /// Returns the phase with the given name.
    pub fn part(&self, name: &str) -> Option<&Part> {
        self.phases.iter().find(|part| part.name == name)
    }

    /// Returns the phase with the largest median.
    pub fn dominant(&self) -> Option<&Part> {
        dominant(&self.phases)
    }
}

/// Returns the phase with the largest median, not counting `total`.
pub fn dominant(parts: &[Part]) -> Option<&Part> {
    parts.iter().filter(|part| part.name != "total" && part.p50 > 0.0).max_by(|a, b| a.p50.total_cmp(&b.p50))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_leave_out_what_is_no_number() {
        let times = [f64::NAN, 10.0, 9.0, 8.0, 7.0, 6.0, 5.0, 4.0, 3.0, 2.0, 1.0];
        let part = Part::from_samples("up", times.to_vec()).expect("times");
        assert_eq!((part.p50, part.p90, part.max), (5.0, 9.0, 10.0));
        assert_eq!(Part::from_samples("up", vec![f64::NAN]), None);
    }
}
