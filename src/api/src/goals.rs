//! Outcome of action goals: `GET /api/v1/servants/ID/goals`.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::Millis;

/// A goal sent to a servant.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Goal {
    /// Name of the action.
    pub action: String,
    /// Goal id, as assigned by the client.
    pub id: String,
    /// Description of the client that sent the goal, or a note that the sending was not observed.
    pub by: String,
    /// Time when the goal was first observed; the time of its end if only that was observed.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub began: Millis,
    /// Time when the goal ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub ended: Option<Millis>,
    /// State of the goal.
    pub state: GoalState,
    /// Status text of the action server.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub text: String,
}

/// Goal states, named as the terminal states of `actionlib_msgs/GoalStatus`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum GoalState {
    /// The goal has not ended.
    Underway,
    /// Cancelled while it was being executed.
    Preempted,
    /// Reached.
    Succeeded,
    /// Aborted by the server.
    Aborted,
    /// Rejected by the server.
    Rejected,
    /// Cancelled before execution began.
    Recalled,
    /// The outcome is unknown.
    Lost,
}

impl fmt::Display for GoalState {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            GoalState::Underway => "is in progress",
            GoalState::Preempted => "was cancelled",
            GoalState::Succeeded => "succeeded",
            GoalState::Aborted => "was aborted by the server",
            GoalState::Rejected => "was rejected",
            GoalState::Recalled => "was cancelled before it started",
            GoalState::Lost => "was lost",
        })
    }
}
