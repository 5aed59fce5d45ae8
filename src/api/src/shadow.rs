//! Shadow runs: `POST /api/v1/services/NAME/shadow` sends a copy of the requests that robots send to their servants to
//! a candidate revision and compares the answers. Robots receive nothing from the candidate. The response is a stream
//! of [`ShadowEvent`]s. Times are in milliseconds.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::calibration::TimeSpread;
use crate::problem::Problem;

/// Options of a shadow run: the candidate, the source of requests, and the criteria of equality.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct ShadowOptions {
    /// Candidate revision.
    pub revision: u64,
    /// Robot whose requests are copied (default: the first that uses the service).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub robot: Option<String>,
    /// Maximum duration in seconds, counted from the first robot (default: 60).
    pub seconds: f64,
    /// Number of requests after which the run ends (default: unlimited).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub requests: Option<u64>,
    /// Tolerance for numbers: a and b are equal if |a - b| is at most this value, multiplied by max(1, |a|, |b|) unless
    /// both are integers (default: 1e-6).
    pub tolerance: f64,
    /// Fields that may differ, such as `pose.covariance`, including their subfields, in any topic, service or action.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub ignore: Vec<String>,
    /// Allowed relative increase of the candidate's median response time (0.1 = 10 %; default: 0.1).
    pub bound: f64,
    /// True if the candidate may use the access it is granted outside its container: hosts, directories, devices.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub acting: bool,
}

impl Default for ShadowOptions {
    fn default() -> ShadowOptions {
        ShadowOptions {
            revision: 0,
            robot: None,
            seconds: 60.0,
            requests: None,
            tolerance: 1e-6,
            ignore: Vec::new(),
            bound: 0.1,
            acting: false,
        }
    }
}

/// One line of the response. The last line is `done` or `error`; a stream that ends otherwise was truncated.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum ShadowEvent {
    /// A new step begins.
    Step {
        /// Title of the step.
        title: String,
    },
    /// The comparison is complete.
    Done {
        /// Result of the comparison.
        shadow: Box<Shadow>,
    },
    /// The comparison could not be made.
    Error {
        /// Reason of the failure, and the next step.
        problem: Problem,
    },
}

/// Verdict of a comparison.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// Nothing could be compared.
    #[default]
    Nothing,
    /// The candidate gave the same answers as the robot's servant, and was as fast.
    Equal,
    /// The candidate gave the same answers, but was slower.
    Slower,
    /// The candidate gave different, missing or additional answers.
    Different,
    /// Nodes of the candidate failed.
    Failed,
}

impl fmt::Display for Verdict {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Verdict::Nothing => "nothing compared",
            Verdict::Equal => "equal",
            Verdict::Slower => "slower",
            Verdict::Different => "different",
            Verdict::Failed => "failed",
        })
    }
}

/// Result of a shadow run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Shadow {
    /// Name of the service.
    pub service: String,
    /// Robot whose requests were copied.
    pub robot: String,
    /// Revision of the robot's servant.
    pub revision: u64,
    /// Candidate revision.
    pub candidate: u64,
    /// Verdict.
    pub verdict: Verdict,
    /// Explanation of the verdict.
    pub why: String,
    /// Duration in seconds for which requests were copied.
    pub seconds: f64,
    /// Reason why the run ended.
    pub ended: String,
    /// Number of messages, calls and goals sent to the candidate.
    pub given: u64,
    /// Comparisons, one for each published topic, service and action.
    pub compared: Vec<Compared>,
    /// Things that could not be compared.
    pub not_compared: Vec<NotCompared>,
}

/// Kind of what is compared.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// Messages of a topic.
    #[default]
    Topic,
    /// Responses of a service.
    Service,
    /// Results of an action.
    Action,
}

impl fmt::Display for Kind {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Kind::Topic => "topic",
            Kind::Service => "service",
            Kind::Action => "action",
        })
    }
}

/// Comparison of one topic, service or action.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Compared {
    /// Kind.
    pub kind: Kind,
    /// Name of the topic, service or action.
    pub name: String,
    /// Number of answers given by both that are equal, including calls that both refused.
    pub equal: u64,
    /// Number of answers given by both that differ.
    pub different: u64,
    /// Number of answers given only by the robot's servant.
    pub missing: u64,
    /// Number of answers given only by the candidate.
    pub surplus: u64,
    /// Response times of the robot's servant; absent if answers cannot be matched to requests.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub present: Option<TimeSpread>,
    /// Response times of the candidate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub candidate: Option<TimeSpread>,
    /// Fields that differ, most frequent first.
    pub fields: Vec<FieldDifference>,
}

impl Compared {
    /// Returns the number of all answers of either revision.
    pub fn answers(&self) -> u64 {
        self.equal + self.unequal()
    }

    /// Returns the number of answers that are different, missing or surplus.
    pub fn unequal(&self) -> u64 {
        self.different + self.missing + self.surplus
    }
}

/// A field that differs.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct FieldDifference {
    /// Path of the field, such as `detections[].score`; empty if the answers differ as a whole.
    pub field: String,
    /// Number of answers in which the field differs.
    pub answers: u64,
    /// First value of the robot's servant, shortened.
    pub present: String,
    /// Corresponding value of the candidate, shortened.
    pub candidate: String,
}

/// Something that could not be compared.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct NotCompared {
    /// A topic, service or action, or some part of the traffic.
    pub what: String,
    /// Reason.
    pub why: String,
    /// Number of occurrences; 0 if irrelevant.
    pub count: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_have_defaults_and_name_what_is_unknown() {
        let read = |text: &str| serde_json::from_str::<ShadowOptions>(text);
        let options = read(r#"{"revision":3}"#).expect("valid");
        let expected = ShadowOptions { revision: 3, ..ShadowOptions::default() };
        assert_eq!(options, expected);
        let refused = read(r#"{"revision":3,"time":4}"#).expect_err("unknown");
        assert!(refused.to_string().contains("`time`"), "{refused}");
    }
}
