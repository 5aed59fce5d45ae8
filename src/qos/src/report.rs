//! What one node's quality of service looks like, for diagnostics on the robot and `explain` in the cloud.

use serde::{Deserialize, Serialize};

use crate::decider::{Event, LocalState};
use crate::phases::Quantiles;
use crate::sla::{Local, Mode};

/// A snapshot; times are in seconds unless said otherwise.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// T_desire.
    pub t_desire: f64,
    /// T_max.
    pub t_max: f64,
    /// Satisfaction now.
    pub q: f64,
    /// Q_t.
    pub threshold: f64,
    /// Stateless or stateful.
    pub mode: Mode,
    /// How the local original is kept.
    pub local: Local,
    /// How its process is.
    pub local_state: LocalState,
    /// Requests go to it, too.
    pub fed: bool,
    /// The link to the cloud is up.
    pub link: bool,
    /// No time is promised: seconds without a link after which the local original stands in. T_desire, T_max, Q and Q_t
    /// mean nothing then.
    #[serde(default)]
    pub fallback_after: Option<f64>,
    /// Which input triggers which outputs, as `/in -> /out by stamp`.
    pub pairs: Vec<String>,
    /// Since the node began.
    pub counts: Counts,
    /// Of the last requests, milliseconds.
    pub phases: Vec<Quantiles>,
    /// The last decisions, the newest last.
    pub events: Vec<TimedEvent>,
    /// Stateful: what was lost at the last hand-over, and how many seconds ago that was.
    #[serde(default)]
    pub lost: Option<(f64, String)>,
    /// One sentence: who answers, and why.
    pub summary: String,
}

/// How requests went.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Counts {
    /// Calls, goals, and inputs that await an answer.
    pub requests: u64,
    /// The cloud answered within T_desire (or the measure kept it).
    pub desired: u64,
    /// The cloud answered within T_max.
    pub accepted: u64,
    /// The cloud did not answer by T_max.
    pub late: u64,
    /// Inputs that the cloud left out, because its node was at another one: they count for nothing.
    #[serde(default)]
    pub left_out: u64,
    /// Answers that the application got from the cloud.
    pub from_cloud: u64,
    /// Answers that the application got from the local original.
    pub from_local: u64,
    /// Answers that came when the request had one already.
    pub duplicates: u64,
    /// Requests that passed T_max with no answer of either side.
    pub unanswered_in_time: u64,
    /// Requests that were given up, with a reason.
    pub failed: u64,
    /// Times the safe-stop message was published.
    pub safe_stops: u64,
}

/// A decision, and when it was taken.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TimedEvent {
    /// Seconds ago.
    pub ago: f64,
    /// What was decided.
    pub event: Event,
}
