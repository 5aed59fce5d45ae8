//! `status`, `set_level`: status messages from the server, and the level that the client wants.

use std::borrow::Cow;

use crate::fields::Fields;
use crate::message::Message;
use crate::{Id, Problem, Writer};

/// Severity of a status message; in `set_level` the least severe level to send.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub enum StatusLevel {
    /// No status messages are sent.
    None,
    /// Failures.
    #[default]
    Error,
    /// Also unusual events that are not failures.
    Warning,
    /// Also successes.
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

    fn read(fields: &Fields<'_>) -> Result<Self, Problem> {
        const EXPECTED: &str = "info, warning, error or none";
        match &*fields.required_text("level", EXPECTED)? {
            "none" => Ok(StatusLevel::None),
            "error" => Ok(StatusLevel::Error),
            "warning" => Ok(StatusLevel::Warning),
            "info" => Ok(StatusLevel::Info),
            other => {
                let found = format!("{:?}", other.chars().take(48).collect::<String>());
                Err(Problem::Mistyped { field: "level", expected: EXPECTED, found })
            }
        }
    }
}

/// Sets the level of status messages that are sent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SetLevel<'a> {
    /// Id of the interaction.
    pub id: Option<Id<'a>>,
    /// Least severe level to send.
    pub level: StatusLevel,
}

impl<'a> Message<'a> for SetLevel<'a> {
    const OP: &'static str = "set_level";
    const FIELDS: &'static [&'static str] = &["level"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        Ok(Self { id, level: StatusLevel::read(fields)? })
    }

    fn id(&self) -> Option<&Id<'a>> {
        self.id.as_ref()
    }

    fn write(&self, writer: &mut Writer<'_>) {
        writer.text("level", self.level.name());
    }
}

/// A status message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Status<'a> {
    /// Id of the op it answers.
    pub id: Option<Id<'a>>,
    /// Severity.
    pub level: StatusLevel,
    /// Text of the message.
    pub msg: Cow<'a, str>,
}

impl<'a> Message<'a> for Status<'a> {
    const OP: &'static str = "status";
    const FIELDS: &'static [&'static str] = &["level", "msg"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        Ok(Self { id, level: StatusLevel::read(fields)?, msg: fields.data("msg", "a text")? })
    }

    fn id(&self) -> Option<&Id<'a>> {
        self.id.as_ref()
    }

    fn write(&self, writer: &mut Writer<'_>) {
        writer.text("level", self.level.name());
        writer.text("msg", &self.msg);
    }
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
