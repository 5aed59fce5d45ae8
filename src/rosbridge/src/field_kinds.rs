//! Kinds of fields: how each is read, checked and written. The text of a kind tells in errors what is expected.

use std::borrow::Cow;
use std::time::Duration;

use crate::fields::Fields;
use crate::{Compression, GoalStatus, Id, Payload, Problem, QosRequest, StatusLevel, Writer};

pub(crate) const TOPIC: Text = Text("a topic name");
pub(crate) const SERVICE: Text = Text("a service name");
pub(crate) const ACTION: Text = Text("an action name");
pub(crate) const MESSAGE_TYPE: &str = "a message type such as \"std_msgs/String\"";
pub(crate) const SERVICE_TYPE: &str = "a service type such as \"std_srvs/Trigger\"";
pub(crate) const ACTION_TYPE: Text = Text("an action type such as \"actionlib_tutorials/Fibonacci\"");
pub(crate) const GOAL_ID: RequiredId = RequiredId("the id that the goal was sent with");

/// Kind of a field.
pub(crate) trait FieldKind<'a> {
    /// The field in Rust.
    type Value;
    /// Reads the field.
    fn read(&self, fields: &Fields<'a>, field: &'static str) -> Result<Self::Value, Problem>;
    /// Writes the field, unless it has its default.
    fn write(&self, value: &Self::Value, writer: &mut Writer<'_>, field: &'static str);
}

/// Kind of an op's id.
pub(crate) trait IdKind<'a> {
    /// The id in Rust.
    type Value;
    /// Checks the id.
    fn read(&self, id: Option<Id<'a>>) -> Result<Self::Value, Problem>;
    /// Returns the id.
    fn get<'v>(&self, value: &'v Self::Value) -> Option<&'v Id<'a>>;
}

/// An id that may be absent.
pub(crate) struct OptionalId;

impl<'a> IdKind<'a> for OptionalId {
    type Value = Option<Id<'a>>;

    fn read(&self, id: Option<Id<'a>>) -> Result<Self::Value, Problem> {
        Ok(id)
    }

    fn get<'v>(&self, value: &'v Self::Value) -> Option<&'v Id<'a>> {
        value.as_ref()
    }
}

/// An id without which the op means nothing.
pub(crate) struct RequiredId(pub(crate) &'static str);

impl<'a> IdKind<'a> for RequiredId {
    type Value = Id<'a>;

    fn read(&self, id: Option<Id<'a>>) -> Result<Self::Value, Problem> {
        id.ok_or(Problem::Missing { field: "id", expected: self.0 })
    }

    fn get<'v>(&self, value: &'v Self::Value) -> Option<&'v Id<'a>> {
        Some(value)
    }
}

/// Implements [`FieldKind`] for a kind by two closures: one reads, one writes.
macro_rules! kind {
    (
        $(#[$doc:meta])* $name:ident $(($argument:ty))?: $value:ty,
        |$self:ident, $fields:ident, $field:ident| $read:expr,
        |$given:ident, $writer:ident| $write:expr
    ) => {
        $(#[$doc])*
        pub(crate) struct $name $((pub(crate) $argument))?;

        impl<'a> FieldKind<'a> for $name {
            type Value = $value;

            fn read(&$self, $fields: &Fields<'a>, $field: &'static str) -> Result<$value, Problem> {
                $read
            }

            fn write(&self, $given: &$value, $writer: &mut Writer<'_>, $field: &'static str) {
                $write
            }
        }
    };
}

kind! {
    /// A text of limited length that must not be empty.
    Text(&'static str): Cow<'a, str>,
    |self, fields, field| fields.required_text(field, self.0),
    |text, writer| writer.text(field, text)
}
kind! {
    /// A text of limited length; an empty one counts as absent.
    OptionalText(&'static str): Option<Cow<'a, str>>,
    |self, fields, field| Ok(fields.text(field, self.0)?.filter(|text| !text.is_empty())),
    |text, writer| if let Some(text) = text { writer.text(field, text) }
}
kind! {
    /// A text of any length.
    Data(&'static str): Cow<'a, str>,
    |self, fields, field| fields.data(field, self.0),
    |text, writer| writer.text(field, text)
}
kind! {
    /// A switch that is off if absent.
    Flag: bool,
    |self, fields, field| Ok(fields.boolean(field)?.unwrap_or(false)),
    |flag, writer| if *flag { writer.boolean(field, true) }
}
kind! {
    /// A boolean that must be given.
    Outcome: bool,
    |self, fields, field| fields.boolean(field)?.ok_or(Problem::Missing { field, expected: "true or false" }),
    |outcome, writer| writer.boolean(field, *outcome)
}
kind! {
    /// An integer that must be given.
    Integer(&'static str): i64,
    |self, fields, field| fields.integer(field)?.ok_or(Problem::Missing { field, expected: self.0 }),
    |number, writer| writer.integer(field, *number)
}
kind! {
    /// A number, not below the first value, that must be given.
    Count((i64, &'static str)): u64,
    |self, fields, field| {
        let (least, expected) = self.0;
        fields.count(field, least, expected)?.ok_or(Problem::Missing { field, expected })
    },
    |count, writer| writer.optional_count(field, Some(*count))
}
kind! {
    /// A number of messages.
    OptionalCount(&'static str): Option<u64>,
    |self, fields, field| fields.count(field, 0, self.0),
    |count, writer| writer.optional_count(field, *count)
}
kind! {
    /// A number of messages; 0 if absent.
    QueueLength: usize,
    |self, fields, field| {
        let length = fields.count(field, 0, "a number of messages, 0 or more,")?;
        Ok(usize::try_from(length.unwrap_or(0)).unwrap_or(usize::MAX))
    },
    |length, writer| if *length > 0 { writer.optional_count(field, Some(*length as u64)) }
}
kind! {
    /// A frame size in bytes.
    FrameSize: Option<usize>,
    |self, fields, field| {
        let size = fields.count(field, 1, "a number of bytes, 1 or more,")?;
        Ok(size.map(|size| usize::try_from(size).unwrap_or(usize::MAX)))
    },
    |size, writer| writer.optional_count(field, size.map(|size| size as u64))
}
kind! {
    /// A time in milliseconds; 0 if absent.
    Milliseconds: Duration,
    |self, fields, field| {
        let time = fields.duration(field, Duration::from_millis(1), "a number of milliseconds, 0 or more,")?;
        Ok(time.unwrap_or_default())
    },
    |time, writer| if !time.is_zero() { writer.number(field, time.as_secs_f64() * 1e3) }
}
kind! {
    /// A time in seconds.
    Seconds: Option<Duration>,
    |self, fields, field| fields.duration(field, Duration::from_secs(1), "a number of seconds, 0 or more,"),
    |time, writer| if let Some(time) = time { writer.number(field, time.as_secs_f64()) }
}
kind! {
    /// A message that must be given.
    MessageObject: Payload<'a>,
    |self, fields, field| fields.object(field),
    |payload, writer| writer.payload(field, *payload)
}
kind! {
    /// A message; an empty one if absent.
    MessageOrEmpty: Payload<'a>,
    |self, fields, field| fields.object_or_empty(field),
    |payload, writer| writer.payload(field, *payload)
}
kind! {
    /// A message, or a list of values in the order of its fields.
    Arguments: Option<Payload<'a>>,
    |self, fields, field| fields.arguments(field),
    |payload, writer| if let Some(payload) = payload { writer.payload(field, *payload) }
}
kind! {
    /// Any value.
    AnyValue: Option<Payload<'a>>,
    |self, fields, field| Ok(fields.payload(field)),
    |payload, writer| if let Some(payload) = payload { writer.payload(field, *payload) }
}
kind! {
    /// An encoding; JSON if absent.
    Encoding: Compression,
    |self, fields, field| Ok(OptionalEncoding.read(fields, field)?.unwrap_or_default()),
    |compression, writer| if *compression != Compression::None { writer.text(field, compression.name()) }
}
kind! {
    /// An encoding.
    OptionalEncoding: Option<Compression>,
    |self, fields, field| {
        const EXPECTED: &str = "none, png, preview, cbor or cbor-raw";
        let Some(name) = fields.text(field, EXPECTED)? else { return Ok(None) };
        let known = if name.is_empty() { Some(Compression::None) } else { Compression::from_name(&name) };
        known.map(Some).ok_or_else(|| unknown_word_error(field, EXPECTED, &name))
    },
    |compression, writer| if let Some(compression) = compression { writer.text(field, compression.name()) }
}
kind! {
    /// A quality of service.
    Qos: Option<QosRequest>,
    |self, fields, field| QosRequest::read(fields, field),
    |qos, writer| if let Some(qos) = qos { qos.write(writer, field) }
}
kind! {
    /// A severity.
    Level: StatusLevel,
    |self, fields, field| {
        const EXPECTED: &str = "info, warning, error or none";
        let name = fields.required_text(field, EXPECTED)?;
        StatusLevel::from_name(&name).ok_or_else(|| unknown_word_error(field, EXPECTED, &name))
    },
    |level, writer| writer.text(field, level.name())
}
kind! {
    /// The number of a goal's status.
    GoalStatusNumber: Option<GoalStatus>,
    |self, fields, field| {
        const EXPECTED: &str = "a number of action_msgs/GoalStatus (4 succeeded, 5 canceled, 6 aborted)";
        let Some(number) = fields.integer(field)? else { return Ok(None) };
        let unknown = || Problem::Mistyped { field, expected: EXPECTED, found: number.to_string() };
        GoalStatus::from_number(number).map(Some).ok_or_else(unknown)
    },
    |status, writer| if let Some(status) = status { writer.integer(field, *status as i64) }
}

fn unknown_word_error(field: &'static str, expected: &'static str, word: &str) -> Problem {
    Problem::Mistyped { field, expected, found: format!("{:?}", word.chars().take(48).collect::<String>()) }
}
