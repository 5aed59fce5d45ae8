//! Rollout of a new revision: at once, or with a canary that serves some robots first.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::Millis;

/// Share of robots served by a canary: `3` for the first three, or `10%` of those that connect.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Share {
    /// The first robots, by number.
    Robots(u32),
    /// Percentage of the robots.
    Percent(f64),
}

#[cfg(feature = "schema")]
impl utoipa::PartialSchema for Share {
    fn schema() -> utoipa::openapi::RefOr<utoipa::openapi::schema::Schema> {
        String::schema()
    }
}

#[cfg(feature = "schema")]
impl utoipa::ToSchema for Share {}

/// Error of parsing a [`Share`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is not a share of robots; write a number of robots, such as 3, or a percentage, such as 10%")]
pub struct ParseShareError(String);

impl FromStr for Share {
    type Err = ParseShareError;

    fn from_str(text: &str) -> Result<Share, ParseShareError> {
        let share = match text.trim().strip_suffix('%') {
            Some(percent) => percent.trim().parse().ok().map(Share::Percent),
            None => text.trim().parse().ok().map(Share::Robots),
        };
        share
            .filter(|share| match share {
                Share::Robots(robots) => *robots > 0,
                Share::Percent(percent) => *percent > 0.0 && *percent <= 100.0,
            })
            .ok_or_else(|| ParseShareError(text.to_owned()))
    }
}

impl TryFrom<String> for Share {
    type Error = ParseShareError;

    fn try_from(text: String) -> Result<Share, ParseShareError> {
        text.parse()
    }
}

impl fmt::Display for Share {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Share::Robots(robots) => write!(out, "{robots}"),
            Share::Percent(percent) => write!(out, "{percent}%"),
        }
    }
}

impl From<Share> for String {
    fn from(share: Share) -> String {
        share.to_string()
    }
}

/// Terms on which a revision replaces another one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct RolloutTerms {
    /// Share of robots that the revision serves before it is promoted (default: promoted at once).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub canary: Option<Share>,
    /// Allowed regression of the canary before it is rolled back: difference of the failure rates, or relative increase
    /// of the response time (0.1 = 10 %; default: 0.1).
    pub bound: f64,
    /// Number of requests to each revision before failures and response times are compared (default: 20).
    pub samples: u32,
    /// Time in seconds after promotion until servants of other revisions are ended (default: when their robots
    /// disconnect).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub deadline: Option<f64>,
    /// Time in seconds after which a canary without regression is promoted if it had at least `samples` requests
    /// (default: only by hand).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub promote_after: Option<f64>,
}

impl Default for RolloutTerms {
    fn default() -> RolloutTerms {
        RolloutTerms { canary: None, bound: 0.1, samples: 20, deadline: None, promote_after: None }
    }
}

/// State of a rollout.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "kebab-case")]
pub enum RolloutState {
    /// The revision serves some robots.
    Canary,
    /// The revision is the current one; servants of other revisions run until their deadline.
    Draining,
    /// The revision is the current one.
    Promoted,
    /// The revision regressed and serves no robots.
    RolledBack,
    /// The rollout was aborted by hand.
    Aborted,
    /// Another revision was published or made the current one.
    Replaced,
}

impl fmt::Display for RolloutState {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.pad(match self {
            RolloutState::Canary => "canary",
            RolloutState::Draining => "draining",
            RolloutState::Promoted => "promoted",
            RolloutState::RolledBack => "rolled back",
            RolloutState::Aborted => "aborted",
            RolloutState::Replaced => "replaced",
        })
    }
}

/// Statistics of one revision since the rollout began.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Arm {
    /// Number of servants that became ready or failed.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub servants: u64,
    /// Number of servants that failed.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub servants_failed: u64,
    /// Number of requests that were answered, failed or were late.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub requests: u64,
    /// Number of requests that failed or were not answered within T_max.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub requests_failed: u64,
    /// Median response time of answered requests, in milliseconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub p50: Option<f64>,
    /// 95th percentile of the response time of answered requests, in milliseconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub p95: Option<f64>,
}

/// Rollout of a service from one revision to another.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Rollout {
    /// Name of the service.
    pub service: String,
    /// Revision that was current when the rollout began.
    pub stable: u64,
    /// Revision that is rolled out.
    pub candidate: u64,
    /// State of the rollout.
    pub state: RolloutState,
    /// Reason for the state.
    pub reason: String,
    /// Reason why a canary that is due for promotion has not been promoted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub waits: Option<String>,
    /// Time when the rollout began.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub started: Millis,
    /// Time of the latest change of state.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub changed: Millis,
    /// Terms of the rollout.
    pub terms: RolloutTerms,
    /// Statistics of the stable revision.
    pub of_stable: Arm,
    /// Statistics of the candidate.
    pub of_candidate: Arm,
}

/// Command to a rollout.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(tag = "order", rename_all = "kebab-case", deny_unknown_fields)]
pub enum RolloutOrder {
    /// Start the rollout of a published revision.
    Start {
        /// Number of the revision.
        revision: u64,
        /// Terms of the rollout.
        #[serde(default)]
        terms: RolloutTerms,
    },
    /// Promote the canary to the current revision.
    Promote,
    /// Abort the rollout of the canary.
    Abort,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_read_and_written() {
        for (text, share) in [
            ("3", Share::Robots(3)),
            ("10%", Share::Percent(10.0)),
            ("0.5%", Share::Percent(0.5)),
            ("100%", Share::Percent(100.0)),
        ] {
            assert_eq!(text.parse(), Ok(share));
            assert_eq!(share.to_string(), text);
        }
        assert_eq!(" 10 % ".parse(), Ok(Share::Percent(10.0)));
        for text in ["0", "0%", "101%", "-1", "-1%", "1.5", "NaN%", "%", "", "ten"] {
            let refused = text.parse::<Share>().expect_err(text);
            assert!(refused.to_string().contains("10%"), "{refused}");
        }
    }

    #[test]
    fn what_is_not_said_of_terms_is_as_by_default() {
        let terms: RolloutTerms = serde_json::from_str(r#"{"canary": "10%"}"#).expect("terms");
        let expected = RolloutTerms { canary: Some(Share::Percent(10.0)), ..RolloutTerms::default() };
        assert_eq!(terms, expected);
    }
}
