//! Events of the daemon's journal.

use serde::{Deserialize, Serialize};

use crate::Millis;

/// Kinds of events of this version, sorted; docs/operators.md describes them.
pub const EVENT_KINDS: [&str; 66] = [
    "base-imported",
    "base-removed",
    "certificate-not-renewed",
    "certificate-refused",
    "certificate-shown",
    "cloud-answers-alone",
    "component-refused",
    "cores-moved",
    "device-incomplete",
    "dictionary-written",
    "duplicate-robot",
    "goal-ended",
    "interface-incomplete",
    "lifecycle-refused",
    "limits-changed",
    "limits-unmet",
    "local-answers-too",
    "local-crashed",
    "local-hands-back",
    "local-missing",
    "local-other",
    "local-takes-over",
    "log-not-kept",
    "machine-recovered",
    "machine-stalled",
    "memory-refused",
    "node-ended",
    "node-failed",
    "node-hung",
    "node-respawned",
    "not-recorded",
    "out-of-memory",
    "published",
    "push-failed",
    "recorded",
    "removed",
    "revocations-read",
    "revocations-refused",
    "rolled-back",
    "rollout-aborted",
    "rollout-promoted",
    "rollout-replaced",
    "rollout-rolled-back",
    "rollout-started",
    "rollout-waits",
    "servant-adopted",
    "servant-back-off",
    "servant-failed",
    "servant-leftover",
    "servant-lost",
    "servant-ready",
    "servant-refused",
    "servant-stopped",
    "servant-unknown",
    "shared-servant",
    "shared-servant-lost",
    "shared-servant-retires",
    "state-lost",
    "state-unwritable",
    "state-writable",
    "terms",
    "terms-changed",
    "terms-refused",
    "underlay-published",
    "underlay-removed",
    "warm-failed",
];

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_is_documented_once() {
        let documented = include_str!("../../../docs/operators.md");
        assert!(EVENT_KINDS.is_sorted_by(|one, next| one < next), "{EVENT_KINDS:?}");
        for kind in EVENT_KINDS {
            assert!(documented.contains(&format!("`{kind}`")), "docs/operators.md lacks {kind}");
        }
    }
}
