//! Messages of actionlib (ROS 1): goals, feedback and results. The part common to all actions precedes the action's own
//! message, so it is read and written by hand and the rest stays a slice.
//!
//! <http://wiki.ros.org/actionlib/DetailedDescription>

use bytes::Bytes;
use ros_message::codec::Time;

/// `actionlib_msgs/GoalStatus`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum ActionlibStatus {
    /// Waiting to be executed.
    Pending = 0,
    /// Being executed.
    Active = 1,
    /// Cancelled during execution.
    Preempted = 2,
    /// Reached.
    Succeeded = 3,
    /// Failed.
    Aborted = 4,
    /// Rejected by the server.
    Rejected = 5,
    /// Being executed, with a cancel request pending.
    Preempting = 6,
    /// Waiting, with a cancel request pending.
    Recalling = 7,
    /// Cancelled before execution.
    Recalled = 8,
    /// The client has not heard of the goal for a long time.
    Lost = 9,
}

impl ActionlibStatus {
    fn from_number(number: u8) -> Option<Self> {
        use ActionlibStatus::*;
        [Pending, Active, Preempted, Succeeded, Aborted, Rejected, Preempting, Recalling, Recalled, Lost]
            .into_iter()
            .find(|status| *status as u8 == number)
    }

    /// Returns true if the goal has ended.
    pub fn is_terminal(self) -> bool {
        use ActionlibStatus::*;
        matches!(self, Preempted | Succeeded | Aborted | Rejected | Recalled | Lost)
    }
}

/// `actionlib_msgs/GoalID`.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct GoalId {
    /// Time at which the goal was sent; zero if irrelevant.
    pub stamp: Time,
    /// The id.
    pub id: String,
}

/// One entry of `actionlib_msgs/GoalStatusArray`, and the head of every feedback and result.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GoalState {
    /// The goal.
    pub goal: GoalId,
    /// Status.
    pub status: ActionlibStatus,
    /// Status text from the server.
    pub text: String,
}

/// Reads a `…ActionGoal`: returns its id and the bytes of the goal itself.
pub fn read_goal(bytes: &Bytes) -> Option<(GoalId, Bytes)> {
    let mut reader = ActionlibReader { bytes, at: 0 };
    reader.header()?;
    let goal = reader.goal_id()?;
    Some((goal, bytes.slice(reader.at..)))
}

/// Reads a `…ActionResult` or `…ActionFeedback`: returns the goal's state and the bytes of the result or feedback
/// itself.
pub fn read_state(bytes: &Bytes) -> Option<(GoalState, Bytes)> {
    let mut reader = ActionlibReader { bytes, at: 0 };
    reader.header()?;
    let state = reader.goal_state()?;
    Some((state, bytes.slice(reader.at..)))
}

/// Returns the goal id in a `…ActionGoal`, `…ActionResult` or `…ActionFeedback`.
pub fn goal_id(bytes: &[u8]) -> Option<String> {
    let mut reader = ActionlibReader { bytes, at: 0 };
    reader.header()?;
    Some(reader.goal_id()?.id)
}

/// Reads an `actionlib_msgs/GoalID`: a cancel request.
pub fn read_cancel(bytes: &[u8]) -> Option<GoalId> {
    ActionlibReader { bytes, at: 0 }.goal_id()
}

/// Reads an `actionlib_msgs/GoalStatusArray`.
pub fn read_states(bytes: &[u8]) -> Option<Vec<GoalState>> {
    let mut reader = ActionlibReader { bytes, at: 0 };
    reader.header()?;
    let count = reader.word()?;
    // Each entry takes at least 17 bytes, so a false count ends here.
    (0..count).map(|_| reader.goal_state()).collect()
}

/// Serializes a `…ActionGoal`.
pub fn write_goal(now: Time, goal: &GoalId, body: &[u8]) -> Bytes {
    let mut out = Vec::with_capacity(64 + body.len());
    write_header(&mut out, now);
    write_goal_id(&mut out, goal);
    out.extend_from_slice(body);
    out.into()
}

/// Serializes a `…ActionResult` or `…ActionFeedback`.
pub fn write_state(now: Time, state: &GoalState, body: &[u8]) -> Bytes {
    let mut out = Vec::with_capacity(96 + body.len());
    write_header(&mut out, now);
    write_goal_state(&mut out, state);
    out.extend_from_slice(body);
    out.into()
}

/// Serializes an `actionlib_msgs/GoalID`.
pub fn write_cancel(goal: &GoalId) -> Bytes {
    let mut out = Vec::new();
    write_goal_id(&mut out, goal);
    out.into()
}

/// Serializes an `actionlib_msgs/GoalStatusArray`.
pub fn write_states<'s>(now: Time, states: impl ExactSizeIterator<Item = &'s GoalState>) -> Bytes {
    let mut out = Vec::new();
    write_header(&mut out, now);
    write_word(&mut out, states.len() as u32);
    for state in states {
        write_goal_state(&mut out, state);
    }
    out.into()
}

struct ActionlibReader<'b> {
    bytes: &'b [u8],
    at: usize,
}

impl ActionlibReader<'_> {
    fn word(&mut self) -> Option<u32> {
        let word = self.bytes.get(self.at..self.at.checked_add(4)?)?;
        self.at += 4;
        word.try_into().ok().map(u32::from_le_bytes)
    }

    fn string(&mut self) -> Option<String> {
        let length = self.word()? as usize;
        let text = self.bytes.get(self.at..self.at.checked_add(length)?)?;
        self.at += length;
        Some(String::from_utf8_lossy(text).into_owned())
    }

    fn time(&mut self) -> Option<Time> {
        Some(Time { secs: self.word()?, nsecs: self.word()? })
    }

    fn header(&mut self) -> Option<()> {
        self.word()?;
        self.time()?;
        self.string().map(drop)
    }

    fn goal_id(&mut self) -> Option<GoalId> {
        Some(GoalId { stamp: self.time()?, id: self.string()? })
    }

    fn goal_state(&mut self) -> Option<GoalState> {
        let goal = self.goal_id()?;
        let status = ActionlibStatus::from_number(*self.bytes.get(self.at)?)?;
        self.at += 1;
        Some(GoalState { goal, status, text: self.string()? })
    }
}

fn write_word(out: &mut Vec<u8>, word: u32) {
    out.extend_from_slice(&word.to_le_bytes());
}

fn write_string(out: &mut Vec<u8>, text: &str) {
    write_word(out, text.len() as u32);
    out.extend_from_slice(text.as_bytes());
}

fn write_time(out: &mut Vec<u8>, time: Time) {
    write_word(out, time.secs);
    write_word(out, time.nsecs);
}

fn write_header(out: &mut Vec<u8>, stamp: Time) {
    write_word(out, 0);
    write_time(out, stamp);
    write_string(out, "");
}

fn write_goal_id(out: &mut Vec<u8>, goal: &GoalId) {
    write_time(out, goal.stamp);
    write_string(out, &goal.id);
}

fn write_goal_state(out: &mut Vec<u8>, state: &GoalState) {
    write_goal_id(out, &state.goal);
    out.push(state.status as u8);
    write_string(out, &state.text);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state() -> GoalState {
        let goal = GoalId { stamp: Time { secs: 5, nsecs: 6 }, id: "g-1".to_owned() };
        GoalState { goal, status: ActionlibStatus::Active, text: "on it".to_owned() }
    }

    #[test]
    fn goals_and_results_survive() {
        let now = Time { secs: 1, nsecs: 2 };
        let goal = write_goal(now, &state().goal, b"body");
        assert_eq!(read_goal(&goal), Some((state().goal, Bytes::from_static(b"body"))));
        let result = write_state(now, &state(), b"body");
        assert_eq!(read_state(&result), Some((state(), Bytes::from_static(b"body"))));
        assert_eq!(read_cancel(&write_cancel(&state().goal)), Some(state().goal));
        let states = [state(), GoalState { status: ActionlibStatus::Lost, ..state() }];
        assert_eq!(read_states(&write_states(now, states.iter())).unwrap(), states);
    }

    #[test]
    fn the_layout_is_that_of_the_generated_messages() {
        let registry = ros_message::schema::Registry::new();
        registry.insert("x/action/Do", "int32 order\n---\nint32 sum\n---\nint32 part\n").unwrap();
        let action = registry.action("x/Do").unwrap();
        let goal = write_goal(Time::default(), &state().goal, &7i32.to_le_bytes());
        ros_message::codec::validate(&action.action_goal, &goal).unwrap();
        let result = write_state(Time::default(), &state(), &7i32.to_le_bytes());
        ros_message::codec::validate(&action.action_result, &result).unwrap();
        ros_message::codec::validate(&action.action_feedback, &result).unwrap();
        let states = registry.message("actionlib_msgs/GoalStatusArray").unwrap();
        ros_message::codec::validate(&states, &write_states(Time::default(), [state()].iter())).unwrap();
    }

    #[test]
    fn torn_messages_are_refused() {
        let whole = write_state(Time::default(), &state(), b"");
        assert_eq!(goal_id(&whole).as_deref(), Some("g-1"));
        for end in 0..whole.len() {
            assert_eq!(read_state(&whole.slice(..end)), None, "{end}");
        }
        let mut many = write_states(Time::default(), [].iter()).to_vec();
        let at = many.len() - 4;
        many[at..].copy_from_slice(&u32::MAX.to_le_bytes());
        assert_eq!(read_states(&many), None);
    }
}
