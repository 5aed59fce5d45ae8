//! How a service comes to its next revision: at once, or by a canary that serves some robots first.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::Millis;

/// Which robots a canary serves: `3`, the first three, or `10%` of those that come.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Share {
    /// The first so many robots.
    Robots(u32),
    /// Percent of the robots.
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

impl FromStr for Share {
    type Err = String;

    fn from_str(text: &str) -> Result<Share, String> {
        let share = match text.trim().strip_suffix('%') {
            Some(percent) => percent.trim().parse().ok().map(Share::Percent),
            None => text.trim().parse().ok().map(Share::Robots),
        };
        share
            .filter(|share| match share {
                Share::Robots(robots) => *robots > 0,
                Share::Percent(percent) => *percent > 0.0 && *percent <= 100.0,
            })
            .ok_or_else(|| {
                format!("{text:?} is no share of robots; write a number of robots, such as 3, or a percentage, such as 10%")
            })
    }
}

impl TryFrom<String> for Share {
    type Error = String;

    fn try_from(text: String) -> Result<Share, String> {
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

/// On which terms a revision takes another's place.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct RolloutTerms {
    /// Robots that it serves before it is the current one; none: it is that at once.
    pub canary: Option<Share>,
    /// By how much the canary may be worse before it is taken back: of its share of failures the difference, of its response times
    /// the part by which they are longer.
    pub bound: f64,
    /// Requests of each revision before their failures and times are compared.
    pub samples: u32,
    /// Seconds from becoming the current one to the end of servants of other revisions; none: they end when their robots leave.
    pub deadline: Option<f64>,
    /// Seconds after which a canary that was not worse becomes the current one, if there were `samples` requests to it; none: when
    /// somebody says so.
    pub promote_after: Option<f64>,
}

impl Default for RolloutTerms {
    fn default() -> RolloutTerms {
        RolloutTerms {
            canary: None,
            bound: 0.1,
            samples: 20,
            deadline: None,
            promote_after: None,
        }
    }
}

/// How far a revision has come on its way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "kebab-case")]
pub enum RolloutState {
    /// It serves some robots.
    Canary,
    /// It is the current one, and servants of others are there until their deadline.
    Draining,
    /// It is the current one.
    Promoted,
    /// It was worse, and serves nobody.
    RolledBack,
    /// Somebody took it back.
    Aborted,
    /// Another revision was published, or made the current one.
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

/// What was seen of one revision since the rollout began.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Arm {
    /// Servants that became ready or failed.
    pub servants: u64,
    /// Those that failed.
    pub servants_failed: u64,
    /// Requests that were answered, failed or were late.
    pub requests: u64,
    /// Those that failed, or were not answered within T_max.
    pub requests_failed: u64,
    /// Median of the answered ones' response times, milliseconds.
    pub p50: Option<f64>,
    /// Their 95th percentile.
    pub p95: Option<f64>,
}

/// A service on its way from one revision to another.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Rollout {
    /// The service.
    pub service: String,
    /// The revision that was the current one.
    pub stable: u64,
    /// The revision that is to be.
    pub candidate: u64,
    /// How far it has come.
    pub state: RolloutState,
    /// The reason of its state.
    pub reason: String,
    /// The reason why a canary is not promoted whose time for that has come.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub waits: Option<String>,
    /// When it began.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub started: Millis,
    /// When its state changed last.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub changed: Millis,
    /// On which terms.
    pub terms: RolloutTerms,
    /// What was seen of the stable revision.
    pub of_stable: Arm,
    /// What was seen of the candidate.
    pub of_candidate: Arm,
}

/// What is to be done about a rollout.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(tag = "order", rename_all = "kebab-case", deny_unknown_fields)]
pub enum RolloutOrder {
    /// A published revision begins its way.
    Start {
        /// The revision's number.
        revision: u64,
        /// On which terms.
        #[serde(default)]
        terms: RolloutTerms,
    },
    /// The canary becomes the current revision.
    Promote,
    /// The canary is taken back.
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
        for text in [
            "0", "0%", "101%", "-1", "-1%", "1.5", "NaN%", "%", "", "ten",
        ] {
            let refused = text.parse::<Share>().expect_err(text);
            assert!(refused.contains("10%"), "{refused}");
        }
    }

    #[test]
    fn what_is_not_said_of_terms_is_as_by_default() {
        let terms: RolloutTerms = serde_json::from_str(r#"{"canary": "10%"}"#).expect("terms");
        let expected = RolloutTerms {
            canary: Some(Share::Percent(10.0)),
            ..RolloutTerms::default()
        };
        assert_eq!(terms, expected);
    }
}
