//! `status`, `set_level`: what the server has to say, and how much of it the client wants to hear.

use std::borrow::Cow;

use crate::fields::Fields;
use crate::op::Message;
use crate::{Id, Problem, Writer};

/// How grave a status is, and, in `set_level`, down to which gravity the client wants to hear.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub enum Level {
    /// No status message is sent.
    None,
    /// What did not work.
    #[default]
    Error,
    /// And what worked, though something was odd.
    Warning,
    /// And what worked.
    Info,
}

impl Level {
    /// The name in the protocol.
    pub fn name(self) -> &'static str {
        match self {
            Level::None => "none",
            Level::Error => "error",
            Level::Warning => "warning",
            Level::Info => "info",
        }
    }

    fn read(fields: &Fields<'_>) -> Result<Self, Problem> {
        const EXPECTED: &str = "info, warning, error or none";
        match &*fields.required_text("level", EXPECTED)? {
            "none" => Ok(Level::None),
            "error" => Ok(Level::Error),
            "warning" => Ok(Level::Warning),
            "info" => Ok(Level::Info),
            other => {
                let found = format!("{:?}", other.chars().take(48).collect::<String>());
                Err(Problem::Mistyped {
                    field: "level",
                    expected: EXPECTED,
                    found,
                })
            }
        }
    }
}

/// "Tell me this much."
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SetLevel<'a> {
    /// The interaction.
    pub id: Option<Id<'a>>,
    /// The least grave status to send.
    pub level: Level,
}

impl<'a> Message<'a> for SetLevel<'a> {
    const OP: &'static str = "set_level";
    const FIELDS: &'static [&'static str] = &["level"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        Ok(Self {
            id,
            level: Level::read(fields)?,
        })
    }

    fn id(&self) -> Option<&Id<'a>> {
        self.id.as_ref()
    }

    fn write(&self, writer: &mut Writer<'_>) {
        writer.text("level", self.level.name());
    }
}

/// "This happened."
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Status<'a> {
    /// The id of the op it answers.
    pub id: Option<Id<'a>>,
    /// How grave it is.
    pub level: Level,
    /// What happened.
    pub msg: Cow<'a, str>,
}

impl<'a> Message<'a> for Status<'a> {
    const OP: &'static str = "status";
    const FIELDS: &'static [&'static str] = &["level", "msg"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        Ok(Self {
            id,
            level: Level::read(fields)?,
            msg: fields.data("msg", "a text")?,
        })
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
    use crate::op::tests::{reads, refuses, survives_cbor};

    #[test]
    fn levels_are_ordered_by_how_much_is_heard() {
        assert!(
            Level::None < Level::Error
                && Level::Error < Level::Warning
                && Level::Warning < Level::Info
        );
    }

    #[test]
    fn status_and_set_level_are_read_and_checked() {
        let op = Status {
            id: Some("x".into()),
            level: Level::Error,
            msg: "no \"such\" topic".into(),
        };
        reads(
            r#"{"op":"status","id":"x","level":"error","msg":"no \"such\" topic"}"#,
            op.clone(),
        );
        survives_cbor(op);
        let op = SetLevel {
            id: None,
            level: Level::Info,
        };
        reads(r#"{"op":"set_level","level":"info"}"#, op.clone());
        survives_cbor(op);
        refuses(
            r#"{"op":"set_level","level":"all"}"#,
            "set_level: field \"level\" is \"all\", info, warning, error or none is expected",
        );
        refuses(
            r#"{"op":"set_level"}"#,
            "set_level: field \"level\" is missing, info, warning, error or none is expected",
        );
    }
}
