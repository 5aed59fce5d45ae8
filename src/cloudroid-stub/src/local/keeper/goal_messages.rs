//! Messages of the calls that make up actions, read and written in CDR as far as they are the same for all actions
//! (<https://design.ros2.org/articles/actions.html>). Goals and results themselves are not decoded.

use bytes::Bytes;

/// Id of a goal, a UUID.
pub type GoalId = [u8; 16];

/// CDR header for little endian.
const HEADER: [u8; 4] = [0, 1, 0, 0];
/// Offset of a message behind the header.
const BEGIN: usize = HEADER.len();
/// Id that stands for all goals in a request to cancel.
pub const ALL: GoalId = [0; 16];
/// Status of a goal that its server does not know (`action_msgs/msg/GoalStatus`).
const UNKNOWN: u8 = 0;

/// Returns the id at the beginning of goals, feedback, and requests for results or to cancel.
pub fn goal_id(message: &[u8]) -> Option<GoalId> {
    message.get(BEGIN..BEGIN + 16)?.try_into().ok()
}

/// Returns whether the response to a goal says that it is accepted.
pub fn is_accepted(answer: &[u8]) -> bool {
    answer.get(BEGIN).is_some_and(|accepted| *accepted != 0)
}

/// Encodes the response to a goal: whether it is accepted, and when, by this machine's clock in nanoseconds.
pub fn goal_response(accepted: bool, now: i64) -> Bytes {
    let secs = i32::try_from(now / 1_000_000_000).unwrap_or(i32::MAX);
    let nsecs = u32::try_from(now % 1_000_000_000).unwrap_or(0);
    let mut answer = HEADER.to_vec();
    answer.extend([u8::from(accepted), 0, 0, 0]);
    answer.extend(secs.to_le_bytes());
    answer.extend(nsecs.to_le_bytes());
    answer.into()
}

/// Encodes a request for the result of a goal.
pub fn result_request(id: &GoalId) -> Bytes {
    [&HEADER[..], id].concat().into()
}

/// Returns whether a response is the result of a known goal; a response about an unknown goal arrives at once and is no
/// result.
pub fn is_result(answer: &[u8]) -> bool {
    answer.get(BEGIN).is_some_and(|status| *status != UNKNOWN)
}

/// Encodes a request to cancel a goal, whenever it was accepted.
pub fn cancel_request(id: &GoalId) -> Bytes {
    [&HEADER[..], id, &[0; 8]].concat().into()
}

/// Returns whether the response to a request to cancel lists goals that end now.
pub fn has_canceled_goals(answer: &[u8]) -> bool {
    let count = answer.get(BEGIN + 4..BEGIN + 8);
    answer.get(BEGIN) == Some(&0) && count.is_some_and(|count| count != [0; 4])
}

/// Encodes the response to a request to cancel, with the goals that end now.
pub fn cancel_response(ids: &[GoalId]) -> Bytes {
    let count = u32::try_from(ids.len()).unwrap_or(u32::MAX);
    let mut answer = HEADER.to_vec();
    answer.extend([0; 4]);
    answer.extend(count.to_le_bytes());
    for id in ids {
        answer.extend(id);
        answer.extend([0; 8]);
    }
    answer.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read() {
        let id = [7; 16];
        assert_eq!(goal_id(&result_request(&id)), Some(id));
        assert_eq!(goal_id(&cancel_request(&id)), Some(id));
        assert_eq!(goal_id(&HEADER), None);
        let accepted = goal_response(true, 3_000_000_004);
        assert_eq!(accepted[..], [0, 1, 0, 0, 1, 0, 0, 0, 3, 0, 0, 0, 4, 0, 0, 0]);
        assert!(is_accepted(&accepted) && !is_accepted(&goal_response(false, 0)) && !is_accepted(&[]));
        assert!(
            has_canceled_goals(&cancel_response(&[id]))
                && !has_canceled_goals(&cancel_response(&[]))
                && !has_canceled_goals(&[])
        );
        assert!(is_result(&[0, 1, 0, 0, 4, 0, 0, 0]) && !is_result(&[0, 1, 0, 0, 0, 0, 0, 0]));
    }
}
