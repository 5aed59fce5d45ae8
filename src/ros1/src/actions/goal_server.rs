//! Goals of an actionlib server, independent of the transport: topics of a node, or of a component that represents
//! servers elsewhere ([`GoalTopics`](super::goal_topics::GoalTopics)).
//!
//! ```text
//!  goal ──▶ begin ─▶ accept, end_goal            publish_feedback, end_goal ─▶ GoalServerTopics
//!  cancel ─▶ cancel
//! ```
//!
//! The states are those of <http://wiki.ros.org/actionlib/DetailedDescription>:
//!
//! ```text
//!   begin           accept           end_goal
//!  ──────▶ PENDING ───────▶ ACTIVE ───────────▶ SUCCEEDED, PREEMPTED, ABORTED
//!             │ cancel         │ cancel
//!             ▼     accept     ▼     end_goal
//!         RECALLING ──────▶ PREEMPTING ───────▶ likewise
//!             │ end_goal
//!             ▼
//!         RECALLED, REJECTED, ABORTED, SUCCEEDED
//! ```
//!
//! A goal that is begun waits for `accept`; feedback counts as such, because only a goal that is executed has any. A
//! cancel may overtake its goal, which arrives on another topic: then it is remembered.
//!
//! Each status lists all goals. It is published periodically and at changes, which whoever sends goals and cancels can
//! cause without end; so those beyond a rate wait for the next periodic one.

mod table;
#[cfg(test)]
mod tests;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use budget::Budget;
use bytes::Bytes;
use parking_lot::Mutex;
use ros_bus::{GoalEnd, GoalOutcome};
use ros_message::codec::{Time, default_message};
use ros_message::schema::ActionDef;
use tokio::time::Instant;

use self::table::{GoalTable, Received};
use super::STATUS_PERIOD;
use super::messages::{self, GoalState};

/// Maximum number of statuses that are published at changes within a [`STATUS_PERIOD`].
const MOST_AT_CHANGES: u32 = 16;
/// Maximum length in bytes of a goal's id, which each status repeats.
const LONGEST_ID: usize = 1024;

/// Goals that were sent without an id so far.
static UNNAMED_GOALS: AtomicU64 = AtomicU64::new(1);

/// Topics to which a server publishes. Must not block, and must not call the server.
pub trait GoalServerTopics: Send + Sync + 'static {
    /// Publishes the statuses of all goals.
    fn publish_status(&self, message: Bytes);
    /// Publishes the feedback of one goal.
    fn publish_feedback(&self, message: Bytes);
    /// Publishes the result of one goal.
    fn publish_result(&self, message: Bytes);
}

/// The most that a server holds for those who send goals.
#[derive(Debug, Clone)]
pub struct GoalLimits {
    /// Maximum number of goals that have not ended; more are rejected. As many ended ones are remembered.
    pub goals: usize,
    /// Budget for goals that have not ended.
    pub budget: Budget,
    /// Owner of the goals, for the reason of a rejection: `this robot`.
    pub holder: &'static str,
}

/// One action and its goals.
pub struct GoalServer<T> {
    name: String,
    of: Arc<ActionDef>,
    topics: T,
    goals: Mutex<GoalTable>,
    /// Held while something is published, so that the last status is current and no feedback follows a result.
    telling: Mutex<StatusRate>,
}

/// Statuses that were published at changes since some time.
#[derive(Default)]
struct StatusRate {
    since: Option<Instant>,
    published: u32,
}

impl StatusRate {
    /// Returns whether another one may be published now, which counts as done.
    fn admit(&mut self) -> bool {
        if self.since.is_none_or(|since| since.elapsed() >= STATUS_PERIOD) {
            *self = Self { since: Some(Instant::now()), published: 0 };
        }
        let has_room = self.published < MOST_AT_CHANGES;
        self.published += u32::from(has_room);
        has_room
    }
}

impl<T: GoalServerTopics> GoalServer<T> {
    /// Creates a server without goals.
    pub fn new(name: &str, of: &Arc<ActionDef>, topics: T, limits: GoalLimits) -> Self {
        Self {
            name: name.to_owned(),
            of: Arc::clone(of),
            topics,
            goals: Mutex::new(GoalTable::new(limits)),
            telling: Mutex::default(),
        }
    }

    /// Returns the action's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the topics to which it publishes.
    pub fn topics(&self) -> &T {
        &self.topics
    }

    /// Receives a `…ActionGoal`; returns the id and the serialized goal if the goal is to be executed. It is pending
    /// then, which is not published yet. A goal that was cancelled before, or for which there is no room, ends at once;
    /// one that is known already is ignored, as by actionlib.
    pub fn begin(&self, message: &Bytes) -> Option<(String, Bytes)> {
        let action = &self.name;
        let Some((mut goal, body)) = messages::read_goal(message) else {
            tracing::debug!(action, "a goal that cannot be read was ignored");
            return None;
        };
        if goal.id.is_empty() {
            goal.id = format!("{action}-{}", UNNAMED_GOALS.fetch_add(1, Ordering::Relaxed));
        }
        if goal.id.len() > LONGEST_ID {
            tracing::debug!(action, bytes = goal.id.len(), "a goal with an overlong id was ignored");
            return None;
        }
        let id = goal.id.clone();
        let received = self.goals.lock().begin(goal, body.len());
        match received {
            Received::Begun => Some((id, body)),
            Received::Known => {
                tracing::debug!(action, id, "a goal with the id of another was ignored");
                None
            }
            Received::Ended(state) => {
                let mut telling = self.telling.lock();
                self.tell_end(&state, &default_message(&self.of.result), &mut telling);
                None
            }
        }
    }

    /// Marks a goal as being executed; does nothing if it is already, or has ended.
    pub fn accept(&self, id: &str) {
        let mut telling = self.telling.lock();
        self.tell_accepted(id, &mut telling);
    }

    /// Cancels goals by actionlib's policy: an empty id means all goals up to the stamp, and with a zero stamp all
    /// goals; an id that goal, and with a stamp also all goals up to it. Returns the ids of the goals that were not
    /// cancelled before.
    pub fn cancel(&self, message: &[u8]) -> Vec<String> {
        let Some(wanted) = messages::read_cancel(message).filter(|wanted| wanted.id.len() <= LONGEST_ID) else {
            let action = &self.name;
            tracing::debug!(action, "a cancel that cannot be read was ignored");
            return Vec::new();
        };
        let cancelled = self.goals.lock().cancel(wanted);
        self.announce_status();
        cancelled
    }

    /// Returns the ids of the goals that have not ended.
    pub fn under_way(&self) -> Vec<String> {
        self.goals.lock().under_way()
    }

    /// Publishes feedback for a goal; returns false if no goal with this id is active.
    pub fn publish_feedback(&self, id: &str, feedback: &[u8]) -> bool {
        let mut telling = self.telling.lock();
        self.tell_accepted(id, &mut telling);
        let state = self.goals.lock().state_under_way(id);
        if let Some(state) = &state {
            self.topics.publish_feedback(messages::write_state(Time::now(), state, feedback));
        }
        state.is_some()
    }

    /// Ends a goal; returns false if no goal with this id is active.
    pub fn end_goal(&self, id: &str, end: GoalEnd) -> bool {
        let mut telling = self.telling.lock();
        let ended = self.goals.lock().end(id, end.outcome, end.text);
        if let Some(state) = &ended {
            self.tell_end(state, &end.result, &mut telling);
        }
        ended.is_some()
    }

    /// Ends a goal without a result of its own; returns false if no goal with this id is active.
    pub fn end_without_result(&self, id: &str, outcome: GoalOutcome, text: String) -> bool {
        self.end_goal(id, GoalEnd { outcome, text, result: default_message(&self.of.result).into() })
    }

    /// Publishes the statuses of all goals, without those that ended some time ago. It is to be called every
    /// [`STATUS_PERIOD`].
    pub fn publish_status(&self) {
        let _telling = self.telling.lock();
        self.write_status();
    }

    /// Publishes the statuses because one has changed, unless that happens too often.
    pub fn announce_status(&self) {
        self.tell_status(&mut self.telling.lock());
    }

    fn tell_accepted(&self, id: &str, telling: &mut StatusRate) {
        let changed = self.goals.lock().accept(id);
        if changed {
            self.tell_status(telling);
        }
    }

    /// Publishes the result before the status, as actionlib does.
    fn tell_end(&self, state: &GoalState, result: &[u8], telling: &mut StatusRate) {
        self.topics.publish_result(messages::write_state(Time::now(), state, result));
        self.tell_status(telling);
    }

    fn tell_status(&self, telling: &mut StatusRate) {
        if telling.admit() {
            self.write_status();
        }
    }

    fn write_status(&self) {
        let states = self.goals.lock().states();
        self.topics.publish_status(messages::write_states(Time::now(), states.iter()));
    }
}
