//! What the calls of actions say, read and written in CDR as far as it is the same for all actions
//! (<https://design.ros2.org/articles/actions.html>). Goals and results themselves are not looked at.

use bytes::Bytes;

/// Names a goal: a UUID.
pub type GoalId = [u8; 16];

/// CDR in little endian.
const HEADER: [u8; 4] = [0, 1, 0, 0];
/// Where a message begins behind it.
const BEGIN: usize = HEADER.len();
/// Stands for all goals in a request to cancel.
pub const ALL: GoalId = [0; 16];
/// The status of a goal that its server knows nothing of (`action_msgs/msg/GoalStatus`).
const UNKNOWN: u8 = 0;

/// The id that goals, feedback, and requests for results or to cancel begin with.
pub fn id_of(message: &[u8]) -> Option<GoalId> {
    message.get(BEGIN..BEGIN + 16)?.try_into().ok()
}

/// Whether an answer to a goal says that it is accepted.
pub fn is_accepted(answer: &[u8]) -> bool {
    answer.get(BEGIN).is_some_and(|accepted| *accepted != 0)
}

/// Answers a goal: whether it is accepted, and when, by this machine's clock in nanoseconds.
pub fn answer(accepted: bool, now: i64) -> Bytes {
    let secs = i32::try_from(now / 1_000_000_000).unwrap_or(i32::MAX);
    let nsecs = u32::try_from(now % 1_000_000_000).unwrap_or(0);
    let mut answer = HEADER.to_vec();
    answer.extend([u8::from(accepted), 0, 0, 0]);
    answer.extend(secs.to_le_bytes());
    answer.extend(nsecs.to_le_bytes());
    answer.into()
}

/// Asks for the result of a goal.
pub fn get_result(id: &GoalId) -> Bytes {
    [&HEADER[..], id].concat().into()
}

/// Whether an answer with a result is of a goal that was known. Else it comes at once and means nothing.
pub fn is_result(answer: &[u8]) -> bool {
    answer.get(BEGIN).is_some_and(|status| *status != UNKNOWN)
}

/// Asks for a goal to be cancelled, whenever it was accepted.
pub fn cancel(id: &GoalId) -> Bytes {
    [&HEADER[..], id, &[0; 8]].concat().into()
}

/// Whether an answer to a request to cancel names goals that end now.
pub fn cancels(answer: &[u8]) -> bool {
    let count = answer.get(BEGIN + 4..BEGIN + 8);
    answer.get(BEGIN) == Some(&0) && count.is_some_and(|count| count != [0; 4])
}

/// Says that these goals end now.
pub fn canceled(ids: &[GoalId]) -> Bytes {
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
        assert_eq!(id_of(&get_result(&id)), Some(id));
        assert_eq!(id_of(&cancel(&id)), Some(id));
        assert_eq!(id_of(&HEADER), None);
        let accepted = answer(true, 3_000_000_004);
        assert_eq!(
            accepted[..],
            [0, 1, 0, 0, 1, 0, 0, 0, 3, 0, 0, 0, 4, 0, 0, 0]
        );
        assert!(is_accepted(&accepted) && !is_accepted(&answer(false, 0)) && !is_accepted(&[]));
        assert!(cancels(&canceled(&[id])) && !cancels(&canceled(&[])) && !cancels(&[]));
        assert!(is_result(&[0, 1, 0, 0, 4, 0, 0, 0]) && !is_result(&[0, 1, 0, 0, 0, 0, 0, 0]));
    }
}
