//! A report of one node's quality of service, for diagnostics on the robot and `explain` in the cloud.

use serde::{Deserialize, Serialize};

use crate::decider::{LocalState, QosEvent};
use crate::phases::Quantiles;
use crate::sla::{LocalPolicy, Mode};

/// A snapshot of one node's quality of service; times are in seconds unless noted otherwise.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QosReport {
    /// T_desire.
    pub t_desire: f64,
    /// T_max.
    pub t_max: f64,
    /// Current satisfaction Q.
    pub q: f64,
    /// Threshold Q_t.
    pub threshold: f64,
    /// Stateless or stateful.
    pub mode: Mode,
    /// Policy for the local original.
    pub local: LocalPolicy,
    /// State of its process.
    pub local_state: LocalState,
    /// Requests are sent to it as well.
    pub fed: bool,
    /// The link to the cloud is up.
    pub link: bool,
    /// Without a response-time goal: seconds without a link after which the local original takes over. T_desire, T_max,
    /// Q and Q_t have no meaning then.
    #[serde(default)]
    pub fallback_after: Option<f64>,
    /// Pairs of input and outputs, as `/in -> /out by stamp`.
    pub pairs: Vec<String>,
    /// Counts since the node started.
    pub counts: RequestCounts,
    /// Quantiles of the last requests' phases, in milliseconds.
    pub phases: Vec<Quantiles>,
    /// The last decisions, newest last.
    pub events: Vec<TimedEvent>,
    /// For a stateful service: what was lost at the last hand-over, and how many seconds ago that was.
    #[serde(default)]
    pub lost: Option<(f64, String)>,
    /// One sentence: which side answers, and why.
    pub summary: String,
}

/// Counters of requests by outcome.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RequestCounts {
    /// Number of calls, goals, and inputs that await an answer.
    pub requests: u64,
    /// Requests that the cloud answered within T_desire (or for which the measure met its goal).
    pub desired: u64,
    /// Requests that the cloud answered within T_max.
    pub accepted: u64,
    /// Requests that the cloud did not answer by T_max.
    pub late: u64,
    /// Inputs that the cloud skipped, because its node was busy with another one; they do not count towards Q.
    #[serde(default)]
    pub left_out: u64,
    /// Answers from the cloud that were delivered to the application.
    pub from_cloud: u64,
    /// Answers from the local original that were delivered to the application.
    pub from_local: u64,
    /// Answers that arrived when the request had been answered already.
    pub duplicates: u64,
    /// Requests that no side had answered by T_max.
    pub unanswered_in_time: u64,
    /// Requests that failed with a reason.
    pub failed: u64,
    /// Number of safe-stop messages published.
    pub safe_stops: u64,
}

/// A decision and its age.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TimedEvent {
    /// Age in seconds.
    pub ago: f64,
    /// The decision.
    pub event: QosEvent,
}
