//! Messages between the parts of an action, whose last fields are goals, results and feedback. Messages from untrusted
//! peers are read only as far as they extend.

use bytes::Bytes;
use ros_bus::RosVersion;
use ros_message::codec::Time;
use ros_message::codec::cursor::MessageCursor;
use ros_message::codec::embedded::extract_embedded;
use ros_message::codec::put::CdrWriter;
use ros_message::schema::MessageType;

use super::GoalId;

/// Size of a goal id, at the beginning of messages that have one.
const ID: usize = 16;
/// Size of a goal's status, before its result.
const STATUS: usize = 1;

/// Status of a goal (`action_msgs/msg/GoalStatus`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum ActionGoalStatus {
    Unknown = 0,
    Accepted = 1,
    Executing = 2,
    Canceling = 3,
    Succeeded = 4,
    Canceled = 5,
    Aborted = 6,
}

impl ActionGoalStatus {
    /// Returns true if the goal has ended.
    pub(super) fn is_terminal(self) -> bool {
        self >= Self::Succeeded
    }

    fn from_number(number: u8) -> Option<Self> {
        Some(match number {
            0 => Self::Unknown,
            1 => Self::Accepted,
            2 => Self::Executing,
            3 => Self::Canceling,
            4 => Self::Succeeded,
            5 => Self::Canceled,
            6 => Self::Aborted,
            _ => return None,
        })
    }
}

/// Result of a cancel request (`action_msgs/srv/CancelGoal`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum CancelCode {
    None = 0,
    Rejected = 1,
    UnknownGoal = 2,
    Terminated = 3,
}

/// A goal and the time at which it was accepted (`action_msgs/msg/GoalInfo`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct GoalInfo {
    pub(super) id: GoalId,
    pub(super) stamp: Time,
}

/// Reads the message of this type that follows a goal id: a goal or feedback.
pub(super) fn read_after_id(of: &MessageType, bytes: &[u8]) -> Option<Bytes> {
    extract_embedded(of, bytes, ID, &[])
}

/// Writes a goal or feedback behind its id.
pub(super) fn write_with_id(id: GoalId, of: &MessageType, bytes: &[u8]) -> Option<Bytes> {
    extract_embedded(of, bytes, 0, &id.0)
}

/// Reads the id that a message begins with.
pub(super) fn read_id(bytes: &[u8]) -> Option<GoalId> {
    take_id(&mut MessageCursor::new(RosVersion::Two, bytes)?)
}

/// Writes a request for the result of a goal.
pub(super) fn write_id(id: GoalId) -> Bytes {
    let mut put = CdrWriter::new();
    put.bytes(&id.0);
    put.finish()
}

/// Reads whether a goal was accepted; the time is ignored.
pub(super) fn read_accepted(bytes: &[u8]) -> Option<bool> {
    let [accepted] = MessageCursor::new(RosVersion::Two, bytes)?.number()?;
    Some(accepted != 0)
}

/// Writes whether a goal is accepted, and when.
pub(super) fn write_accepted(accepted: bool, stamp: Time) -> Bytes {
    let mut put = CdrWriter::new();
    put.byte(u8::from(accepted));
    put_time(&mut put, stamp);
    put.finish()
}

/// Reads the final status of a goal and its result; the status is `None` if it is not a defined one.
pub(super) fn read_result(of: &MessageType, bytes: &[u8]) -> Option<(Option<ActionGoalStatus>, Bytes)> {
    let [status] = MessageCursor::new(RosVersion::Two, bytes)?.number()?;
    Some((ActionGoalStatus::from_number(status), extract_embedded(of, bytes, STATUS, &[])?))
}

/// Writes the final status of a goal and its result.
pub(super) fn write_result(status: ActionGoalStatus, of: &MessageType, result: &[u8]) -> Option<Bytes> {
    extract_embedded(of, result, 0, &[status as u8])
}

/// Reads which goals are to be cancelled.
pub(super) fn read_cancel(bytes: &[u8]) -> Option<GoalInfo> {
    take_info(&mut MessageCursor::new(RosVersion::Two, bytes)?)
}

/// Writes a cancel request.
pub(super) fn write_cancel(wanted: GoalInfo) -> Bytes {
    let mut put = CdrWriter::new();
    put_info(&mut put, wanted);
    put.finish()
}

/// Reads whether a goal is among those being cancelled; otherwise returns the code.
pub(super) fn read_cancelled(bytes: &[u8], id: GoalId) -> Option<Result<(), u8>> {
    let mut cursor = MessageCursor::new(RosVersion::Two, bytes)?;
    let [code] = cursor.number()?;
    for _ in 0..cursor.length()? {
        if take_info(&mut cursor)?.id == id {
            return Some(Ok(()));
        }
    }
    Some(Err(code))
}

/// Writes which goals are being cancelled.
pub(super) fn write_cancelled(code: CancelCode, goals: &[GoalInfo]) -> Bytes {
    let mut put = CdrWriter::new();
    put.byte(code as u8);
    put.length(goals.len());
    for goal in goals {
        put_info(&mut put, *goal);
    }
    put.finish()
}

/// Writes the statuses of all goals.
pub(super) fn write_statuses(goals: &[(GoalInfo, ActionGoalStatus)]) -> Bytes {
    let mut put = CdrWriter::new();
    put.length(goals.len());
    for (goal, status) in goals {
        put_info(&mut put, *goal);
        put.byte(*status as u8);
    }
    put.finish()
}

fn take_id(cursor: &mut MessageCursor<'_>) -> Option<GoalId> {
    cursor.take(ID, 1)?.try_into().ok().map(GoalId)
}

fn take_info(cursor: &mut MessageCursor<'_>) -> Option<GoalInfo> {
    let id = take_id(cursor)?;
    let secs = u32::from_le_bytes(cursor.number()?);
    let nsecs = u32::from_le_bytes(cursor.number()?);
    let stamp = Time { secs, nsecs };
    Some(GoalInfo { id, stamp })
}

fn put_info(put: &mut CdrWriter, info: GoalInfo) {
    put.bytes(&info.id.0);
    put_time(put, info.stamp);
}

fn put_time(put: &mut CdrWriter, time: Time) {
    put.number(time.secs.to_le_bytes());
    put.number(time.nsecs.to_le_bytes());
}
