//! `send_action_goal`, `cancel_action_goal`, `action_feedback`, `action_result`, `advertise_action`,
//! `unadvertise_action`.

use std::borrow::Cow;

use crate::fields::Fields;
use crate::message::Message;
use crate::service::split_name;
use crate::subscribe::fragment_size;
use crate::{Compression, Id, Payload, Problem, Writer};

const ACTION: &str = "an action name";
const TYPE: &str = "an action type such as \"actionlib_tutorials/Fibonacci\"";
const GOAL_ID: &str = "the id that the goal was sent with";

/// Status of a goal: the numbers of `action_msgs/GoalStatus`, which the protocol prescribes for ROS 1 too.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum GoalStatus {
    /// The status is not known.
    Unknown = 0,
    /// Accepted, but not started yet.
    Accepted = 1,
    /// In progress.
    Executing = 2,
    /// Being cancelled.
    Canceling = 3,
    /// Completed successfully.
    Succeeded = 4,
    /// Cancelled at the client's request.
    Canceled = 5,
    /// Given up by the server.
    Aborted = 6,
}

impl GoalStatus {
    /// Converts from the number on the wire.
    pub fn from_number(number: i64) -> Option<Self> {
        Some(match number {
            0 => GoalStatus::Unknown,
            1 => GoalStatus::Accepted,
            2 => GoalStatus::Executing,
            3 => GoalStatus::Canceling,
            4 => GoalStatus::Succeeded,
            5 => GoalStatus::Canceled,
            6 => GoalStatus::Aborted,
            _ => return None,
        })
    }
}

/// Sends a goal: from the client to an action server, or from the server to a client that is one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SendActionGoal<'a> {
    /// Id of the goal in feedback, result and cancel.
    pub id: Option<Id<'a>>,
    /// Name of the action.
    pub action: Cow<'a, str>,
    /// Type of the action: `package/Name`.
    pub action_type: Cow<'a, str>,
    /// Goal: an object, or a list of values in the order of the goal's fields.
    pub args: Option<Payload<'a>>,
    /// Requests feedback.
    pub feedback: bool,
    /// Maximum frame size in bytes; longer frames are fragmented.
    pub fragment_size: Option<usize>,
    /// Encoding of feedback and result; with `cbor-raw` also of the goal.
    pub compression: Option<Compression>,
}

impl<'a> Message<'a> for SendActionGoal<'a> {
    const OP: &'static str = "send_action_goal";
    const FIELDS: &'static [&'static str] =
        &["action", "action_type", "args", "feedback", "fragment_size", "compression"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        let (action, id) = split_name(fields.required_text("action", ACTION)?, id);
        Ok(Self {
            id,
            action,
            action_type: fields.required_text("action_type", TYPE)?,
            args: fields.arguments("args")?,
            feedback: fields.boolean("feedback")?.unwrap_or(false),
            fragment_size: fragment_size(fields)?,
            compression: Compression::read_optional(fields)?,
        })
    }

    fn id(&self) -> Option<&Id<'a>> {
        self.id.as_ref()
    }

    fn write(&self, writer: &mut Writer<'_>) {
        writer.text("action", &self.action);
        writer.text("action_type", &self.action_type);
        if let Some(args) = self.args {
            writer.payload("args", args);
        }
        if self.feedback {
            writer.boolean("feedback", true);
        }
        writer.optional_count("fragment_size", self.fragment_size.map(|size| size as u64));
        if let Some(compression) = self.compression {
            writer.text("compression", compression.name());
        }
    }
}

/// Cancels a goal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CancelActionGoal<'a> {
    /// Id of the goal.
    pub id: Id<'a>,
    /// Name of the action.
    pub action: Cow<'a, str>,
}

impl<'a> Message<'a> for CancelActionGoal<'a> {
    const OP: &'static str = "cancel_action_goal";
    const FIELDS: &'static [&'static str] = &["action"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        let (action, id) = split_name(fields.required_text("action", ACTION)?, id);
        Ok(Self { id: id.ok_or(Problem::Missing { field: "id", expected: GOAL_ID })?, action })
    }

    fn id(&self) -> Option<&Id<'a>> {
        Some(&self.id)
    }

    fn write(&self, writer: &mut Writer<'_>) {
        writer.text("action", &self.action);
    }
}

/// Feedback on a goal, from an action server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ActionFeedback<'a> {
    /// Id of the goal.
    pub id: Id<'a>,
    /// Name of the action.
    pub action: Cow<'a, str>,
    /// Feedback message.
    pub values: Payload<'a>,
    /// Encoding: `cbor-raw` if `values` holds the ROS serialization (extension).
    pub compression: Compression,
}

impl<'a> Message<'a> for ActionFeedback<'a> {
    const OP: &'static str = "action_feedback";
    const FIELDS: &'static [&'static str] = &["action", "values", "compression"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        Ok(Self {
            id: id.ok_or(Problem::Missing { field: "id", expected: GOAL_ID })?,
            action: fields.required_text("action", ACTION)?,
            values: fields.object("values")?,
            compression: Compression::read(fields)?,
        })
    }

    fn id(&self) -> Option<&Id<'a>> {
        Some(&self.id)
    }

    fn write(&self, writer: &mut Writer<'_>) {
        writer.text("action", &self.action);
        self.compression.write(writer);
        writer.payload("values", self.values);
    }
}

/// Result of a goal, from an action server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ActionResult<'a> {
    /// Id of the goal.
    pub id: Option<Id<'a>>,
    /// Name of the action.
    pub action: Cow<'a, str>,
    /// Result message, or, if `result` is false, the reason as a string.
    pub values: Option<Payload<'a>>,
    /// Final status, if given.
    pub status: Option<GoalStatus>,
    /// True if there is a result.
    pub result: bool,
    /// Encoding: `cbor-raw` if `values` holds the ROS serialization (extension).
    pub compression: Compression,
}

impl<'a> Message<'a> for ActionResult<'a> {
    const OP: &'static str = "action_result";
    const FIELDS: &'static [&'static str] = &["action", "values", "status", "result", "compression"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        const STATUS: &str = "a number of action_msgs/GoalStatus (4 succeeded, 5 canceled, 6 aborted)";
        let status = match fields.integer("status")? {
            None => None,
            Some(number) => Some(GoalStatus::from_number(number).ok_or_else(|| Problem::Mistyped {
                field: "status",
                expected: STATUS,
                found: number.to_string(),
            })?),
        };
        Ok(Self {
            id,
            action: fields.required_text("action", ACTION)?,
            values: fields.payload("values"),
            status,
            result: fields.boolean("result")?.ok_or(Problem::Missing { field: "result", expected: "true or false" })?,
            compression: Compression::read(fields)?,
        })
    }

    fn id(&self) -> Option<&Id<'a>> {
        self.id.as_ref()
    }

    fn write(&self, writer: &mut Writer<'_>) {
        writer.text("action", &self.action);
        self.compression.write(writer);
        if let Some(values) = self.values {
            writer.payload("values", values);
        }
        if let Some(status) = self.status {
            writer.integer("status", status as i64);
        }
        writer.boolean("result", self.result);
    }
}

/// Advertises that the client is an action server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AdvertiseAction<'a> {
    /// Id of the interaction.
    pub id: Option<Id<'a>>,
    /// Name of the action.
    pub action: Cow<'a, str>,
    /// Type of the action: `package/Name`.
    pub type_name: Cow<'a, str>,
    /// Encoding in which the client wants the goals (extension).
    pub compression: Compression,
}

impl<'a> Message<'a> for AdvertiseAction<'a> {
    const OP: &'static str = "advertise_action";
    const FIELDS: &'static [&'static str] = &["action", "type", "compression"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        Ok(Self {
            id,
            action: fields.required_text("action", ACTION)?,
            type_name: fields.required_text("type", TYPE)?,
            compression: Compression::read(fields)?,
        })
    }

    fn id(&self) -> Option<&Id<'a>> {
        self.id.as_ref()
    }

    fn write(&self, writer: &mut Writer<'_>) {
        writer.text("action", &self.action);
        writer.text("type", &self.type_name);
        self.compression.write(writer);
    }
}

/// Ends an [`AdvertiseAction`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnadvertiseAction<'a> {
    /// Id of the interaction.
    pub id: Option<Id<'a>>,
    /// Name of the action.
    pub action: Cow<'a, str>,
}

impl<'a> Message<'a> for UnadvertiseAction<'a> {
    const OP: &'static str = "unadvertise_action";
    const FIELDS: &'static [&'static str] = &["action", "type"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        Ok(Self { id, action: fields.required_text("action", ACTION)? })
    }

    fn id(&self) -> Option<&Id<'a>> {
        self.id.as_ref()
    }

    fn write(&self, writer: &mut Writer<'_>) {
        writer.text("action", &self.action);
    }
}

#[cfg(test)]
#[path = "action_tests.rs"]
mod tests;
