//! `send_action_goal`, `cancel_action_goal`, `action_feedback`, `action_result`, `advertise_action`,
//! `unadvertise_action`.

use std::borrow::Cow;

use crate::field_kinds::{
    ACTION, ACTION_TYPE, AnyValue, Arguments, Encoding, Flag, FrameSize, GOAL_ID, GoalStatusNumber, MessageObject,
    OptionalEncoding, OptionalId, Outcome,
};
use crate::message::message;
use crate::{Compression, Id, Payload};

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

message! {
    /// Sends a goal: from the client to an action server, or from the server to a client that is one.
    SendActionGoal "send_action_goal"
    /// Id of the goal in feedback, result and cancel.
    id: Option<Id<'a>> = OptionalId => action,
    /// Name of the action.
    action: Cow<'a, str> = "action" ACTION,
    /// Type of the action: `package/Name`.
    action_type: Cow<'a, str> = "action_type" ACTION_TYPE,
    /// Goal: an object, or a list of values in the order of the goal's fields.
    args: Option<Payload<'a>> = "args" Arguments,
    /// Requests feedback.
    feedback: bool = "feedback" Flag,
    /// Maximum frame size in bytes; longer frames are fragmented.
    fragment_size: Option<usize> = "fragment_size" FrameSize,
    /// Encoding of feedback and result; with `cbor-raw` also of the goal.
    compression: Option<Compression> = "compression" OptionalEncoding,
}

message! {
    /// Cancels a goal.
    CancelActionGoal "cancel_action_goal"
    /// Id of the goal.
    id: Id<'a> = GOAL_ID => action,
    /// Name of the action.
    action: Cow<'a, str> = "action" ACTION,
}

message! {
    /// Feedback on a goal, from an action server.
    ActionFeedback "action_feedback"
    /// Id of the goal.
    id: Id<'a> = GOAL_ID,
    /// Name of the action.
    action: Cow<'a, str> = "action" ACTION,
    /// Encoding: `cbor-raw` if `values` holds the ROS serialization (extension).
    compression: Compression = "compression" Encoding,
    /// Feedback message.
    values: Payload<'a> = "values" MessageObject,
}

message! {
    /// Result of a goal, from an action server.
    ActionResult "action_result"
    /// Id of the goal.
    id: Option<Id<'a>> = OptionalId,
    /// Name of the action.
    action: Cow<'a, str> = "action" ACTION,
    /// Encoding: `cbor-raw` if `values` holds the ROS serialization (extension).
    compression: Compression = "compression" Encoding,
    /// Result message, or, if `result` is false, the reason as a string.
    values: Option<Payload<'a>> = "values" AnyValue,
    /// Final status, if given.
    status: Option<GoalStatus> = "status" GoalStatusNumber,
    /// True if there is a result.
    result: bool = "result" Outcome,
}

message! {
    /// Advertises that the client is an action server.
    AdvertiseAction "advertise_action"
    /// Id of the interaction.
    id: Option<Id<'a>> = OptionalId,
    /// Name of the action.
    action: Cow<'a, str> = "action" ACTION,
    /// Type of the action: `package/Name`.
    type_name: Cow<'a, str> = "type" ACTION_TYPE,
    /// Encoding in which the client wants the goals (extension).
    compression: Compression = "compression" Encoding,
}

message! {
    /// Ends an [`AdvertiseAction`].
    UnadvertiseAction "unadvertise_action" ignores ["type"]
    /// Id of the interaction.
    id: Option<Id<'a>> = OptionalId,
    /// Name of the action.
    action: Cow<'a, str> = "action" ACTION,
}

#[cfg(test)]
#[path = "action_tests.rs"]
mod tests;
