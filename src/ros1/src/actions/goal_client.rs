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
const ACCEPT_TIMEOUT: Duration = Duration::from_secs(60);

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
    /// Progress of the goal as far as the server has shown it.
    progress: GoalProgress,
    events: Arc<dyn GoalEvents>,
}

/// Progress of a goal as a server's status list shows it.
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
        Self { seen: now, patience: ACCEPT_TIMEOUT, progress: GoalProgress::default(), events }
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
    use super::super::messages::GoalState;
    use super::*;

    /// An event that is reported to a goal's sender.
    #[derive(Debug, Clone, PartialEq)]
    enum GoalUpdate {
        Waiting,
        Accepted,
        Cancelling(bool),
        Feedback,
        Ended(Result<GoalOutcome, String>),
    }

    #[derive(Default)]
    struct Sender(Mutex<Vec<GoalUpdate>>);

    impl Sender {
        fn take_updates(&self) -> Vec<GoalUpdate> {
            std::mem::take(&mut *self.0.lock())
        }
    }

    impl GoalEvents for Sender {
        fn on_waiting(&self) {
            self.0.lock().push(GoalUpdate::Waiting);
        }

        fn on_accepted(&self) {
            self.0.lock().push(GoalUpdate::Accepted);
        }

        fn on_cancel_response(&self, ends: bool) {
            self.0.lock().push(GoalUpdate::Cancelling(ends));
        }

        fn on_feedback(&self, _: Bytes) {
            self.0.lock().push(GoalUpdate::Feedback);
        }

        fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
            let end = end.map(|end| end.outcome).map_err(|error| error.to_string());
            self.0.lock().push(GoalUpdate::Ended(end));
        }
    }

    fn state(id: &str, status: ActionlibStatus) -> GoalState {
        let goal = GoalId { id: id.to_owned(), ..GoalId::default() };
        GoalState { goal, status, text: String::new() }
    }

    impl GoalClient {
        fn send(&self, id: &str) -> Arc<Sender> {
            let sender = Arc::new(Sender::default());
            self.begin(id, &[], Arc::clone(&sender) as _);
            sender
        }

        fn hear_status(&self, states: &[GoalState]) {
            assert!(self.on_status(&messages::write_states(Time::default(), states.iter())));
        }

        fn hear_result(&self, state: &GoalState) {
            self.on_result(&messages::write_state(Time::default(), state, &[]));
        }
    }

    #[test]
    fn a_status_is_reported_once_whatever_was_missed_before() {
        use ActionlibStatus::*;
        use GoalUpdate::{Accepted, Cancelling, Waiting};
        for (statuses, expected) in [
            (vec![Pending, Pending, Active, Preempting, Preempted], vec![Waiting, Accepted, Cancelling(true)]),
            (vec![Active, Active, Succeeded], vec![Accepted]),
            (vec![Recalling, Preempting, Recalled], vec![Waiting, Cancelling(true), Accepted]),
            (vec![Preempting, Aborted], vec![Accepted, Cancelling(true)]),
            (vec![Active, Pending], vec![Accepted]),
            (vec![Rejected, Lost], vec![]),
        ] {
            let client = GoalClient::default();
            let sender = client.send("one");
            statuses.iter().for_each(|status| client.hear_status(&[state("one", *status)]));
            assert_eq!(sender.take_updates(), expected, "{statuses:?}");
        }
    }

    #[test]
    fn each_cancel_is_answered_even_if_others_cancelled_before() {
        let client = GoalClient::default();
        let sender = client.send("one");
        let preempting = [state("one", ActionlibStatus::Preempting)];
        client.hear_status(&preempting);
        assert_eq!(sender.take_updates(), [GoalUpdate::Accepted, GoalUpdate::Cancelling(true)]);
        assert!(client.cancel("one").is_some() && client.cancel("two").is_none());
        client.hear_status(&preempting);
        client.hear_status(&preempting);
        assert_eq!(sender.take_updates(), [GoalUpdate::Cancelling(true)]);
    }

    #[test]
    fn feedback_tells_that_a_goal_is_executed_and_a_result_that_it_has_ended() {
        let client = GoalClient::default();
        let (one, two) = (client.send("one"), client.send("two"));
        let feedback = messages::write_state(Time::default(), &state("one", ActionlibStatus::Active), &[]);
        client.on_feedback(&feedback);
        client.on_feedback(&feedback);
        assert_eq!(one.take_updates(), [GoalUpdate::Accepted, GoalUpdate::Feedback, GoalUpdate::Feedback]);
        // Before any status.
        client.hear_result(&state("one", ActionlibStatus::Preempted));
        client.hear_result(&state("two", ActionlibStatus::Rejected));
        client.hear_status(&[state("one", ActionlibStatus::Preempted), state("two", ActionlibStatus::Rejected)]);
        client.on_feedback(&feedback);
        assert_eq!(one.take_updates(), [GoalUpdate::Ended(Ok(GoalOutcome::Canceled))]);
        assert_eq!(two.take_updates(), [GoalUpdate::Ended(Ok(GoalOutcome::Rejected))]);
    }

    #[test]
    fn statuses_become_outcomes() {
        use ActionlibStatus::*;
        for (status, expected) in [
            (Succeeded, GoalOutcome::Succeeded),
            (Preempted, GoalOutcome::Canceled),
            (Recalled, GoalOutcome::Canceled),
            (Aborted, GoalOutcome::Aborted),
            (Rejected, GoalOutcome::Rejected),
            (Lost, GoalOutcome::Unknown),
            (Active, GoalOutcome::Unknown),
        ] {
            let client = GoalClient::default();
            let sender = client.send("one");
            client.hear_result(&state("one", status));
            assert_eq!(sender.take_updates(), [GoalUpdate::Ended(Ok(expected))], "{status:?}");
        }
    }

    #[test]
    fn a_goal_that_nobody_took_yet_is_waited_for_longer_than_one_that_was_dropped() {
        let begin = Instant::now();
        let after = |seconds| begin + Duration::from_secs(seconds);
        let mut goal = TrackedGoal::new(begin, Arc::new(Sender::default()));
        assert!(!goal.is_lost(after(30)) && goal.is_lost(after(61)));
        goal.mark_seen(after(30));
        assert!(!goal.is_lost(after(34)) && goal.is_lost(after(36)));
    }

    #[test]
    fn goals_end_with_their_server_and_are_cancelled_when_nobody_waits() {
        let client = GoalClient::default();
        let sender = client.send("one");
        client.end_all(&GoalError::ServerGone("/do".to_owned()));
        assert_eq!(sender.take_updates(), [GoalUpdate::Ended(Err("action server /do is gone".to_owned()))]);
        let sender = client.send("two");
        let cancels: Vec<_> = client.abandon().iter().filter_map(|cancel| messages::read_cancel(cancel)).collect();
        assert_eq!(cancels, [GoalId { id: "two".to_owned(), ..GoalId::default() }]);
        client.hear_result(&state("two", ActionlibStatus::Preempted));
        assert_eq!(sender.take_updates(), []);
    }
}
