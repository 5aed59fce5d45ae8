//! Words about requests that all parts share.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

/// Names one request within one node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct RequestId(pub u64);

/// `header.stamp` as the robot's application wrote it: the key by which an output finds its input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Stamp {
    /// Seconds.
    pub secs: u32,
    /// Nanoseconds.
    pub nsecs: u32,
}

impl Stamp {
    /// Nobody set it: it tells nothing.
    pub fn is_zero(self) -> bool {
        self.secs == 0 && self.nsecs == 0
    }
}

/// By what an answer is recognised.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Key {
    /// The input's stamp, which the node copies.
    Stamp(Stamp),
    /// The id of an action's goal (actionlib_msgs/GoalID), which its result and feedback carry.
    Goal(Arc<str>),
}

impl From<Stamp> for Key {
    fn from(stamp: Stamp) -> Self {
        Self::Stamp(stamp)
    }
}

/// Who can answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Side {
    /// The robot's servant.
    Cloud,
    /// The original package on the robot.
    Local,
}

impl Side {
    /// For tables of both sides: the cloud first.
    pub fn index(self) -> usize {
        match self {
            Self::Cloud => 0,
            Self::Local => 1,
        }
    }
}

/// Who is asked at the moment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Sides {
    /// The robot's servant.
    pub cloud: bool,
    /// The original package on the robot.
    pub local: bool,
}

impl Sides {
    /// Each of them, the cloud first.
    pub fn iter(self) -> impl Iterator<Item = Side> {
        let both = [Side::Cloud, Side::Local].into_iter();
        both.filter(move |side| self.has(*side))
    }

    /// Whether this side is one of them.
    pub fn has(self, side: Side) -> bool {
        match side {
            Side::Cloud => self.cloud,
            Side::Local => self.local,
        }
    }
}

/// How far one side is with one request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Leg {
    /// It was not asked.
    NotAsked,
    /// It was asked and has not answered.
    Asked,
    /// It was asked, but the way to it was lost; an answer may still come if the link resumes.
    Lost,
    /// It was given it and answered a later one, or was at an earlier one: no answer is awaited of it.
    LeftOut,
    /// It answered.
    Answered,
    /// It cannot answer.
    Failed(String),
}

/// Why a side gave no result.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Failure {
    /// The node itself said no: its time counts like that of an answer.
    Refused(String),
    /// It could not be asked, or ended: counts as late at this moment.
    Unreachable(String),
}

impl Failure {
    /// What was said.
    pub fn text(&self) -> &str {
        match self {
            Self::Refused(text) | Self::Unreachable(text) => text,
        }
    }
}
