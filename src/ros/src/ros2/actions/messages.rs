//! What the parts of an action say to each other, of which goals, results and feedback are the last fields. Of texts from
//! strangers only as much is read as is there.

use bytes::Bytes;

use super::GoalId;
use crate::bus::RosVersion;
use crate::codec::Time;
use crate::codec::cursor::Cursor;
use crate::codec::embedded::embedded;
use crate::codec::put::Put;
use crate::schema::MessageType;

/// Bytes of a goal's id, which stands at the beginning of what has one.
const ID: usize = 16;
/// Bytes of a goal's status, in front of its result.
const STATUS: usize = 1;

/// How a goal stands (`action_msgs/msg/GoalStatus`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Status {
    Unknown = 0,
    Accepted = 1,
    Executing = 2,
    Canceling = 3,
    Succeeded = 4,
    Canceled = 5,
    Aborted = 6,
}

impl Status {
    /// Whether the goal has ended.
    pub(super) fn is_terminal(self) -> bool {
        self >= Self::Succeeded
    }

    fn of(number: u8) -> Option<Self> {
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

/// What became of a request to cancel (`action_msgs/srv/CancelGoal`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum CancelCode {
    None = 0,
    Rejected = 1,
    UnknownGoal = 2,
    Terminated = 3,
}

/// A goal and when it was accepted (`action_msgs/msg/GoalInfo`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct GoalInfo {
    pub(super) id: GoalId,
    pub(super) stamp: Time,
}

/// The message of this type that stands behind a goal's id: goals and feedback.
pub(super) fn behind_id(of: &MessageType, bytes: &[u8]) -> Option<Bytes> {
    embedded(of, bytes, ID, &[])
}

/// Puts a goal, or feedback, behind its id.
pub(super) fn with_id(id: GoalId, of: &MessageType, bytes: &[u8]) -> Option<Bytes> {
    embedded(of, bytes, 0, &id.0)
}

/// The id that a message begins with.
pub(super) fn read_id(bytes: &[u8]) -> Option<GoalId> {
    take_id(&mut Cursor::new(RosVersion::Two, bytes)?)
}

/// A request for the result of a goal.
pub(super) fn write_id(id: GoalId) -> Bytes {
    let mut put = Put::new();
    put.bytes(&id.0);
    put.end()
}

/// Whether a goal was accepted; when, does not matter here.
pub(super) fn read_accepted(bytes: &[u8]) -> Option<bool> {
    let [accepted] = Cursor::new(RosVersion::Two, bytes)?.number()?;
    Some(accepted != 0)
}

/// Whether a goal is accepted, and when.
pub(super) fn write_accepted(accepted: bool, stamp: Time) -> Bytes {
    let mut put = Put::new();
    put.byte(u8::from(accepted));
    put_time(&mut put, stamp);
    put.end()
}

/// How a goal has ended, and its result; no status where it is none that there is.
pub(super) fn read_result(of: &MessageType, bytes: &[u8]) -> Option<(Option<Status>, Bytes)> {
    let [status] = Cursor::new(RosVersion::Two, bytes)?.number()?;
    Some((Status::of(status), embedded(of, bytes, STATUS, &[])?))
}

/// How a goal has ended, and its result.
pub(super) fn write_result(status: Status, of: &MessageType, result: &[u8]) -> Option<Bytes> {
    embedded(of, result, 0, &[status as u8])
}

/// Which goals are to be cancelled.
pub(super) fn read_cancel(bytes: &[u8]) -> Option<GoalInfo> {
    take_info(&mut Cursor::new(RosVersion::Two, bytes)?)
}

/// Asks for goals to be cancelled.
pub(super) fn write_cancel(wanted: GoalInfo) -> Bytes {
    let mut put = Put::new();
    put_info(&mut put, wanted);
    put.end()
}

/// Whether a goal is among those that are cancelled now, and else the code.
pub(super) fn read_cancelled(bytes: &[u8], id: GoalId) -> Option<Result<(), u8>> {
    let mut cursor = Cursor::new(RosVersion::Two, bytes)?;
    let [code] = cursor.number()?;
    for _ in 0..cursor.length()? {
        if take_info(&mut cursor)?.id == id {
            return Some(Ok(()));
        }
    }
    Some(Err(code))
}

/// Which goals are cancelled now.
pub(super) fn write_cancelled(code: CancelCode, goals: &[GoalInfo]) -> Bytes {
    let mut put = Put::new();
    put.byte(code as u8);
    put.length(goals.len());
    for goal in goals {
        put_info(&mut put, *goal);
    }
    put.end()
}

/// How all goals stand.
pub(super) fn write_statuses(goals: &[(GoalInfo, Status)]) -> Bytes {
    let mut put = Put::new();
    put.length(goals.len());
    for (goal, status) in goals {
        put_info(&mut put, *goal);
        put.byte(*status as u8);
    }
    put.end()
}

fn take_id(cursor: &mut Cursor<'_>) -> Option<GoalId> {
    cursor.take(ID, 1)?.try_into().ok().map(GoalId)
}

fn take_info(cursor: &mut Cursor<'_>) -> Option<GoalInfo> {
    let id = take_id(cursor)?;
    let secs = u32::from_le_bytes(cursor.number()?);
    let nsecs = u32::from_le_bytes(cursor.number()?);
    let stamp = Time { secs, nsecs };
    Some(GoalInfo { id, stamp })
}

fn put_info(put: &mut Put, info: GoalInfo) {
    put.bytes(&info.id.0);
    put_time(put, info.stamp);
}

fn put_time(put: &mut Put, time: Time) {
    put.number(time.secs.to_le_bytes());
    put.number(time.nsecs.to_le_bytes());
}
