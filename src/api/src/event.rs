//! Events of the daemon's journal.

use serde::{Deserialize, Serialize};

use crate::Millis;

/// Severity of an event.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Level {
    /// Normal operation.
    Info,
    /// Deserves attention.
    Warning,
    /// Something failed.
    Error,
}

/// An event in the daemon's journal.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Event {
    /// Event number; increases with every event.
    pub id: i64,
    /// Time of the event.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub time: Millis,
    /// Severity.
    pub level: Level,
    /// Kind of event, such as `servant-ready`.
    pub kind: String,
    /// Service concerned.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub service: Option<String>,
    /// Servant concerned.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub servant: Option<String>,
    /// Robot concerned.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<String>,
    /// Description of the event, in one sentence.
    pub message: String,
}
