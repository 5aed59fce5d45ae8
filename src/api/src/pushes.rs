//! Pushes that run, and those that ended lately: `GET /api/v1/pushes`.

use serde::{Deserialize, Serialize};

use crate::Millis;

/// A push that runs, or that ended lately.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct PushStatus {
    /// Number of the push.
    pub number: u64,
    /// Name of the service; absent while it is not known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub service: Option<String>,
    /// Description of what was pushed.
    pub source: String,
    /// Name of the principal that pushes.
    pub by: String,
    /// State of the push.
    pub state: PushState,
    /// Time when it began.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub began: Millis,
    /// Time when it ended; absent while it runs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub ended: Option<Millis>,
    /// Title of the current step, or of the last one; empty if there was none.
    pub step: String,
    /// Time when the current step began; absent if the push has ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub step_began: Option<Millis>,
    /// Duration of the current step when it was completed last, in milliseconds; absent if that is unknown.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last_took: Option<u64>,
    /// Progress of the current step, if it is counted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub progress: Option<PushCount>,
    /// Reason why it failed; absent otherwise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub message: Option<String>,
    /// True if the caller may read what the push printed.
    pub can_read: bool,
    /// True if the caller may cancel the push, and it runs.
    pub can_cancel: bool,
}

/// State of a push.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum PushState {
    /// It runs, or waits for another push.
    Running,
    /// The revision is published.
    Published,
    /// It failed, or the daemon ended before it did.
    Failed,
    /// Somebody cancelled it.
    Cancelled,
}

impl PushState {
    /// Returns the state as it is written in JSON.
    pub fn name(self) -> &'static str {
        match self {
            PushState::Running => "running",
            PushState::Published => "published",
            PushState::Failed => "failed",
            PushState::Cancelled => "cancelled",
        }
    }
}

/// Progress of a step.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct PushCount {
    /// Unit that is counted, such as `packages` or `bytes`.
    pub unit: String,
    /// Number of units done.
    pub done: u64,
    /// Total number of units, if known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub total: Option<u64>,
}
