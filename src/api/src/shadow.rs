//! Shadows: `POST /api/v1/services/NAME/shadow` gives what robots ask of their servants of a service to a candidate, too, and
//! compares what comes of it. No robot hears anything of the candidate. The answer is a stream of [`ShadowEvent`]s. Times are
//! in milliseconds.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::calibration::TimeSpread;
use crate::problem::Problem;

/// Which revision is the candidate, whose requests it is given, and what counts as equal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct ShadowOptions {
    /// The revision that is the candidate.
    pub revision: u64,
    /// The robot whose requests it is given; without, the first that uses the service.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub robot: Option<String>,
    /// Seconds for which they are, at most, from the first robot on.
    pub seconds: f64,
    /// Requests after which it is enough, if any number is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub requests: Option<u64>,
    /// Two numbers a and b are the same where |a - b| is at most this; unless both are integers, times the greatest of 1, |a|
    /// and |b|.
    pub tolerance: f64,
    /// Fields that may differ, such as `pose.covariance`: with all that is below them, of whatever topic, service or action.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub ignore: Vec<String>,
    /// The part by which the candidate's median response time may be longer.
    pub bound: f64,
    /// The candidate may act on what it is granted outside its container: hosts, directories, devices.
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

/// One line of the answer. The last is `done` or `error`; a stream that ends otherwise was cut.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum ShadowEvent {
    /// A new step begins.
    Step {
        /// What is done now.
        title: String,
    },
    /// The comparison has ended.
    Done {
        /// What was found.
        shadow: Box<Shadow>,
    },
    /// Nothing was compared.
    Error {
        /// The reason, and what to do.
        problem: Problem,
    },
}

/// What a comparison came to.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// Nothing could be compared.
    #[default]
    Nothing,
    /// The candidate answered as the robot's servant did, and as fast.
    Equal,
    /// It answered the same, and took longer.
    Slower,
    /// It answered something else, or not at all, or where the robot's servant did not.
    Different,
    /// Its nodes failed.
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

/// What was found.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Shadow {
    /// The service.
    pub service: String,
    /// The robot whose requests were taken.
    pub robot: String,
    /// The revision of its servant.
    pub revision: u64,
    /// The revision that was compared with it.
    pub candidate: u64,
    /// What it came to.
    pub verdict: Verdict,
    /// Why, in words.
    pub why: String,
    /// For so many seconds requests were taken.
    pub seconds: f64,
    /// Why no longer.
    pub ended: String,
    /// The candidate was given so many messages, calls and goals.
    pub given: u64,
    /// What was compared: each topic that the service publishes, each of its services and actions.
    pub compared: Vec<Compared>,
    /// What could not be.
    pub not_compared: Vec<NotCompared>,
}

/// Kinds of what is compared.
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

/// One topic, service or action.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Compared {
    /// Topic, service or action.
    pub kind: Kind,
    /// Its name.
    pub name: String,
    /// Answers that both gave and that are equal, also where both refused.
    pub equal: u64,
    /// Those that both gave and that differ.
    pub different: u64,
    /// Those that the robot's servant gave alone.
    pub missing: u64,
    /// Those that the candidate gave alone.
    pub surplus: u64,
    /// Response times of the robot's servant; none where an answer cannot be ascribed to a request.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub present: Option<TimeSpread>,
    /// Response times of the candidate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub candidate: Option<TimeSpread>,
    /// Fields that differ, those that do so most often first.
    pub fields: Vec<FieldDifference>,
}

impl Compared {
    /// All answers, of either.
    pub fn answers(&self) -> u64 {
        self.equal + self.unequal()
    }

    /// The number of comparisons whose answers differ.
    pub fn unequal(&self) -> u64 {
        self.different + self.missing + self.surplus
    }
}

/// A field that differs.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct FieldDifference {
    /// Its path, such as `detections[].score`; empty where the whole differs.
    pub field: String,
    /// In so many answers.
    pub answers: u64,
    /// The first value of the robot's servant, shortened.
    pub present: String,
    /// The candidate's instead of it.
    pub candidate: String,
}

/// Something that could not be compared.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct NotCompared {
    /// A topic, a service, an action, or part of what happened.
    pub what: String,
    /// The reason.
    pub why: String,
    /// So often; 0 where that does not matter.
    pub count: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_have_defaults_and_name_what_is_unknown() {
        let read = |text: &str| serde_json::from_str::<ShadowOptions>(text);
        let options = read(r#"{"revision":3}"#).expect("valid");
        let expected = ShadowOptions {
            revision: 3,
            ..ShadowOptions::default()
        };
        assert_eq!(options, expected);
        let refused = read(r#"{"revision":3,"time":4}"#).expect_err("unknown");
        assert!(refused.to_string().contains("`time`"), "{refused}");
    }
}
