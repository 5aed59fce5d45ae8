//! `status`, `set_level`: status messages from the server, and the level that the client wants.

use std::borrow::Cow;

use crate::Id;
use crate::field_kinds::{Data, Level, OptionalId};
use crate::message::message;

/// Severity of a status message; in `set_level` the least severe level to send.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub enum StatusLevel {
    /// No status messages are sent.
    None,
    /// Failures.
    #[default]
    Error,
    /// Failures, and unusual events that are none.
    Warning,
    /// All of these, and successes.
    Info,
}

impl StatusLevel {
    /// Returns the name in the protocol.
    pub fn name(self) -> &'static str {
        match self {
            StatusLevel::None => "none",
            StatusLevel::Error => "error",
            StatusLevel::Warning => "warning",
            StatusLevel::Info => "info",
        }
    }

    /// Converts from the name in the protocol.
    pub(crate) fn from_name(name: &str) -> Option<Self> {
        let all = [StatusLevel::None, StatusLevel::Error, StatusLevel::Warning, StatusLevel::Info];
        all.into_iter().find(|level| level.name() == name)
    }
}

message! {
    /// Sets the level of status messages that are sent.
    SetLevel "set_level"
    /// Id of the interaction.
    id: Option<Id<'a>> = OptionalId,
    /// Least severe level to send.
    level: StatusLevel = "level" Level,
}

message! {
    /// A status message.
    Status "status"
    /// Id of the op it answers.
    id: Option<Id<'a>> = OptionalId,
    /// Severity.
    level: StatusLevel = "level" Level,
    /// Text of the message.
    msg: Cow<'a, str> = "msg" Data("a text"),
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::op::tests::{assert_parses, assert_refused, assert_survives_cbor};

    #[test]
    fn levels_are_ordered_by_how_much_is_heard() {
        assert!(
            StatusLevel::None < StatusLevel::Error
                && StatusLevel::Error < StatusLevel::Warning
                && StatusLevel::Warning < StatusLevel::Info
        );
    }

    #[test]
    fn status_and_set_level_are_read_and_checked() {
        let op = Status { id: Some("x".into()), level: StatusLevel::Error, msg: "no \"such\" topic".into() };
        assert_parses(r#"{"op":"status","id":"x","level":"error","msg":"no \"such\" topic"}"#, op.clone());
        assert_survives_cbor(op);
        let op = SetLevel { id: None, level: StatusLevel::Info };
        assert_parses(r#"{"op":"set_level","level":"info"}"#, op.clone());
        assert_survives_cbor(op);
        assert_refused(
            r#"{"op":"set_level","level":"all"}"#,
            "set_level: field \"level\" is \"all\", info, warning, error or none is expected",
        );
        assert_refused(
            r#"{"op":"set_level"}"#,
            "set_level: field \"level\" is missing, info, warning, error or none is expected",
        );
    }
}
