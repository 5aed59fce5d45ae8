//! What became of the goals of actions: `GET /api/v1/servants/ID/goals`.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::Millis;

/// A goal that a servant was sent.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Goal {
    /// The action.
    pub action: String,
    /// As its client has called it.
    pub id: String,
    /// Who sent it, in words; or that this was not heard.
    pub by: String,
    /// When it was heard of: when it ended, where only that was heard.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub began: Millis,
    /// When it ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub ended: Option<Millis>,
    /// How it ended, or that it has not.
    pub state: GoalState,
    /// What the action's server said to that.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub text: String,
}

/// The states of `actionlib_msgs/GoalStatus` in which a goal ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum GoalState {
    /// It has not ended.
    Underway,
    /// It was cancelled while it was worked at.
    Preempted,
    /// It was reached.
    Succeeded,
    /// The server gave up.
    Aborted,
    /// The server did not take it.
    Rejected,
    /// It was cancelled before it was worked at.
    Recalled,
    /// Nobody knows.
    Lost,
}

impl fmt::Display for GoalState {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            GoalState::Underway => "is under way",
            GoalState::Preempted => "was cancelled",
            GoalState::Succeeded => "succeeded",
            GoalState::Aborted => "was given up by the server",
            GoalState::Rejected => "was rejected",
            GoalState::Recalled => "was cancelled before it began",
            GoalState::Lost => "was lost",
        })
    }
}
