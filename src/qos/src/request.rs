//! Types that describe requests, shared by all parts.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

/// Identifies one request within one node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct RequestId(pub u64);

/// `header.stamp` as written by the robot's application: the key that matches an output to its input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Stamp {
    /// Seconds.
    pub secs: u32,
    /// Nanoseconds.
    pub nsecs: u32,
}

impl Stamp {
    /// Returns true if the stamp was not set and identifies nothing.
    pub fn is_zero(self) -> bool {
        self.secs == 0 && self.nsecs == 0
    }
}

/// The key by which an answer is matched to its request.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum CorrelationKey {
    /// The input's stamp, which the node copies.
    Stamp(Stamp),
    /// Id of an action's goal (actionlib_msgs/GoalID), which its result and feedback carry.
    Goal(Arc<str>),
}

impl From<Stamp> for CorrelationKey {
    fn from(stamp: Stamp) -> Self {
        Self::Stamp(stamp)
    }
}

/// A side that can answer requests.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Responder {
    /// The robot's servant.
    Cloud,
    /// The original package on the robot.
    Local,
}

impl Responder {
    /// Returns the index for tables of both sides; the cloud comes first.
    pub fn index(self) -> usize {
        match self {
            Self::Cloud => 0,
            Self::Local => 1,
        }
    }
}

/// The sides that receive requests at the moment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Responders {
    /// The robot's servant.
    pub cloud: bool,
    /// The original package on the robot.
    pub local: bool,
}

impl Responders {
    /// Returns an iterator over the sides, the cloud first.
    pub fn iter(self) -> impl Iterator<Item = Responder> {
        let both = [Responder::Cloud, Responder::Local].into_iter();
        both.filter(move |side| self.contains(*side))
    }

    /// Returns true if `side` is included.
    pub fn contains(self, side: Responder) -> bool {
        match side {
            Responder::Cloud => self.cloud,
            Responder::Local => self.local,
        }
    }
}

/// Progress of one side on one request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RequestLeg {
    /// The side was not asked.
    NotAsked,
    /// The side was asked and has not answered.
    Asked,
    /// The side was asked, but the link to it was lost; an answer may still come if the link resumes.
    Lost,
    /// The side skipped it: it answered a later request, or was busy with an earlier one. No answer is expected.
    LeftOut,
    /// The side answered.
    Answered,
    /// The side cannot answer, for this reason.
    Failed(String),
}

/// Reason why a side gave no result.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Failure {
    /// The node refused the request; its time counts like that of an answer.
    Refused(String),
    /// The side could not be reached, or ended; the request counts as late now.
    Unreachable(String),
}

impl Failure {
    /// Returns the error text.
    pub fn text(&self) -> &str {
        match self {
            Self::Refused(text) | Self::Unreachable(text) => text,
        }
    }
}
