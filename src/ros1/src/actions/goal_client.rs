//! Goals that were sent to an actionlib server, independent of the transport: topics of a node, or of a component that
//! stands between two systems.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use parking_lot::Mutex;
use ros_bus::{GoalEnd, GoalError, GoalEvents, GoalOutcome};
use ros_message::codec::Time;

use super::messages::{self, ActionlibStatus, GoalId};

/// Time after which a goal that the server no longer lists is lost.
const LOST_AFTER: Duration = Duration::from_secs(5);
/// Time after which a goal that the server never listed is lost. It is much longer: actionlib clients wait forever for
/// that, because a server may be slow, or another one may take the goal in its place.
const NEVER_TAKEN: Duration = Duration::from_secs(60);

/// The goals of one client, followed by what their server publishes.
#[derive(Default)]
pub struct GoalClient {
    goals: Mutex<HashMap<String, TrackedGoal>>,
}

struct TrackedGoal {
    /// Time at which the server last mentioned the goal, or at which it was sent.
    seen: Instant,
    /// Time for which the server may leave the goal unmentioned.
    patience: Duration,
    /// What the server has shown of the goal so far.
    progress: GoalProgress,
    events: Arc<dyn GoalEvents>,
}

/// What a server's status list shows of a goal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct GoalProgress {
    waits: bool,
    accepted: bool,
    cancels: bool,
}

impl GoalProgress {
    fn from_status(status: ActionlibStatus) -> Self {
        use ActionlibStatus::*;
        Self {
            waits: matches!(status, Pending | Recalling),
            accepted: matches!(status, Active | Preempting),
            cancels: matches!(status, Preempting | Recalling),
        }
    }

    fn report(self, events: &dyn GoalEvents) {
        if self.waits {
            events.on_waiting();
        }
        if self.accepted {
            events.on_accepted();
        }
        if self.cancels {
            events.on_cancel_response(true);
        }
    }
}

impl TrackedGoal {
    fn new(now: Instant, events: Arc<dyn GoalEvents>) -> Self {
        Self { seen: now, patience: NEVER_TAKEN, progress: GoalProgress::default(), events }
    }

    /// Returns what this status shows for the first time.
    fn note_status(&mut self, status: ActionlibStatus) -> GoalProgress {
        let (before, shown) = (self.progress, GoalProgress::from_status(status));
        self.progress = GoalProgress {
            // A goal that is being executed waited before.
            waits: before.waits || shown.waits || shown.accepted,
            accepted: before.accepted || shown.accepted,
            cancels: before.cancels || shown.cancels,
        };
        GoalProgress {
            waits: shown.waits && !before.waits,
            accepted: shown.accepted && !before.accepted,
            cancels: shown.cancels && !before.cancels,
        }
    }

    fn mark_seen(&mut self, now: Instant) {
        self.seen = now;
        self.patience = LOST_AFTER;
    }

    fn is_lost(&self, now: Instant) -> bool {
        now.duration_since(self.seen) > self.patience
    }
}

impl GoalClient {
    /// Follows a goal from now on; returns the `…ActionGoal` that is to be published.
    pub fn begin(&self, id: &str, goal: &[u8], events: Arc<dyn GoalEvents>) -> Bytes {
        let known = TrackedGoal::new(Instant::now(), events);
        self.goals.lock().insert(id.to_owned(), known);
        let stamp = Time::now();
        messages::write_goal(stamp, &GoalId { stamp, id: id.to_owned() }, goal)
    }

    /// Returns the message that cancels a goal; `None` if it has ended.
    pub fn cancel(&self, id: &str) -> Option<Bytes> {
        let mut goals = self.goals.lock();
        // The answer is the next status, even if somebody else has cancelled the goal before.
        goals.get_mut(id)?.progress.cancels = false;
        Some(cancel_message(id))
    }

    /// Forgets all goals because nobody waits for them any more; returns the messages that cancel them.
    pub fn abandon(&self) -> Vec<Bytes> {
        let goals = std::mem::take(&mut *self.goals.lock());
        goals.keys().map(|id| cancel_message(id)).collect()
    }

    /// Reads a `…ActionFeedback`, which may concern a goal of somebody else.
    pub fn on_feedback(&self, bytes: &Bytes) {
        let Some((state, body)) = messages::read_state(bytes) else {
            return;
        };
        let (events, news) = match self.goals.lock().get_mut(&state.goal.id) {
            Some(goal) => {
                goal.mark_seen(Instant::now());
                // Only a goal that is executed has feedback.
                (goal.events.clone(), goal.note_status(ActionlibStatus::Active))
            }
            None => return,
        };
        news.report(&*events);
        events.on_feedback(body);
    }

    /// Reads a `…ActionResult`, likewise.
    pub fn on_result(&self, bytes: &Bytes) {
        let Some((state, body)) = messages::read_state(bytes) else {
            return;
        };
        let Some(goal) = self.goals.lock().remove(&state.goal.id) else {
            return;
        };
        let outcome = match state.status {
            ActionlibStatus::Succeeded => GoalOutcome::Succeeded,
            ActionlibStatus::Preempted | ActionlibStatus::Recalled => GoalOutcome::Canceled,
            ActionlibStatus::Aborted => GoalOutcome::Aborted,
            ActionlibStatus::Rejected => GoalOutcome::Rejected,
            _ => GoalOutcome::Unknown,
        };
        goal.events.on_ended(Ok(GoalEnd { outcome, text: state.text, result: body }));
    }

    /// Reads the server's status list; returns false if it cannot be read.
    pub fn on_status(&self, bytes: &[u8]) -> bool {
        let Some(states) = messages::read_states(bytes) else {
            return false;
        };
        let now = Instant::now();
        let (mut lost, mut news) = (Vec::new(), Vec::new());
        let mut goals = self.goals.lock();
        for (id, goal) in goals.iter_mut() {
            if let Some(state) = states.iter().find(|state| state.goal.id == *id) {
                goal.mark_seen(now);
                news.push((goal.events.clone(), goal.note_status(state.status)));
            } else if goal.is_lost(now) {
                lost.push(id.clone());
            }
        }
        let lost: Vec<_> = lost.iter().filter_map(|id| goals.remove(id)).collect();
        drop(goals);
        for (events, news) in news {
            news.report(&*events);
        }
        for goal in lost {
            goal.events.on_ended(Err(GoalError::Forgotten));
        }
        true
    }

    /// Ends all goals for this reason.
    pub fn end_all(&self, reason: &GoalError) {
        let goals = std::mem::take(&mut *self.goals.lock());
        for goal in goals.into_values() {
            goal.events.on_ended(Err(reason.clone()));
        }
    }
}

fn cancel_message(id: &str) -> Bytes {
    messages::write_cancel(&GoalId { stamp: Time::default(), id: id.to_owned() })
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Nobody;

    impl GoalEvents for Nobody {
        fn on_feedback(&self, _: Bytes) {}

        fn on_ended(&self, _: Result<GoalEnd, GoalError>) {}
    }

    #[test]
    fn a_status_is_reported_once_whatever_was_missed_before() {
        use ActionlibStatus::*;
        let nothing = GoalProgress::default();
        let (waits, accepted, cancels) = (
            GoalProgress { waits: true, ..nothing },
            GoalProgress { accepted: true, ..nothing },
            GoalProgress { cancels: true, ..nothing },
        );
        let both = |one: GoalProgress| GoalProgress { cancels: true, ..one };
        for (statuses, expected) in [
            (vec![Pending, Pending, Active, Preempting, Preempted], vec![waits, nothing, accepted, cancels, nothing]),
            (vec![Active, Active, Succeeded], vec![accepted, nothing, nothing]),
            (vec![Recalling, Preempting, Recalled], vec![both(waits), accepted, nothing]),
            (vec![Preempting, Aborted], vec![both(accepted), nothing]),
            (vec![Active, Pending], vec![accepted, nothing]),
            (vec![Rejected, Lost], vec![nothing, nothing]),
        ] {
            let mut goal = TrackedGoal::new(Instant::now(), Arc::new(Nobody));
            let noted: Vec<_> = statuses.iter().map(|status| goal.note_status(*status)).collect();
            assert_eq!(noted, expected, "{statuses:?}");
        }
    }

    #[test]
    fn a_goal_that_nobody_took_yet_is_waited_for_longer_than_one_that_was_dropped() {
        let begin = Instant::now();
        let after = |seconds| begin + Duration::from_secs(seconds);
        let mut goal = TrackedGoal::new(begin, Arc::new(Nobody));
        assert!(!goal.is_lost(after(30)) && goal.is_lost(after(61)));
        goal.mark_seen(after(30));
        assert!(!goal.is_lost(after(34)) && goal.is_lost(after(36)));
    }
}
