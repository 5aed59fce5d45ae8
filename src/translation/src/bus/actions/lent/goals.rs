//! Goals on their way to a server of the robot, and what it says about them.

use std::sync::{Arc, Weak};
use std::time::Duration;

use budget::Permit;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{ActionHandler, ActionServer, FailureReason, GoalEnd, GoalError, GoalEvents, GoalOutcome};
use tokio::sync::OwnedSemaphorePermit;
use tokio::time::sleep;
use tokio_util::task::AbortOnDropHandle;
use tracing::Instrument;

use super::LentAction;

/// Time for a server of the robot to accept or reject a goal.
const ANSWER: Duration = Duration::from_secs(60);

/// Gives goals of the servant's nodes to the robot's server.
pub(super) struct LentGoalHandler(Weak<LentAction>);

impl LentGoalHandler {
    pub(super) fn new(action: &Arc<LentAction>) -> Self {
        Self(Arc::downgrade(action))
    }
}

impl ActionHandler for LentGoalHandler {
    fn on_goal(&self, id: &str, goal: Bytes) -> Result<(), FailureReason> {
        let action = self.0.upgrade().ok_or_else(|| FailureReason::new("no node looks for this action any more"))?;
        action.send_goal(id, &goal)
    }

    fn is_answer_deferred(&self) -> bool {
        true
    }

    fn on_cancel(&self, id: &str) {
        if let Some(action) = self.0.upgrade() {
            action.cancel_goal(id);
        }
    }

    fn on_failed(&self, reason: &str) {
        if let Some(action) = self.0.upgrade() {
            action.report(reason);
        }
    }
}

/// Receives what the robot's server says about one goal.
pub(super) struct LentGoalEvents {
    action: Weak<LentAction>,
    id: String,
    /// Watches the time until the server accepts the goal; taken then.
    unanswered: Mutex<Option<AbortOnDropHandle<()>>>,
    _place: OwnedSemaphorePermit,
    _held: Permit,
}

impl LentGoalEvents {
    /// Begins to watch the time until the robot's server answers; `place` and `held` are kept until the goal has ended.
    pub(super) fn new(action: &Arc<LentAction>, id: &str, place: OwnedSemaphorePermit, held: Permit) -> Self {
        Self {
            action: Arc::downgrade(action),
            id: id.to_owned(),
            unanswered: Mutex::new(Some(watch_answer(action, id))),
            _place: place,
            _held: held,
        }
    }

    fn server(&self) -> Option<Arc<dyn ActionServer>> {
        self.action.upgrade().and_then(|action| action.current_server())
    }

    /// Notes that the robot's server has answered the goal; returns whether it had not before.
    fn note_answer(&self) -> bool {
        self.unanswered.lock().take().is_some()
    }
}

impl GoalEvents for LentGoalEvents {
    fn on_waiting(&self) {
        self.note_answer();
        if let Some(server) = self.server() {
            server.accept_goal(&self.id);
        }
    }

    fn on_accepted(&self) {
        self.note_answer();
        if let Some(server) = self.server() {
            server.execute_goal(&self.id);
        }
    }

    fn on_feedback(&self, feedback: Bytes) {
        if let Some(server) = self.server() {
            server.publish_feedback(&self.id, feedback);
        }
    }

    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        let Some(action) = self.action.upgrade() else {
            return;
        };
        // Without an answer it was not accepted.
        let lost = if self.note_answer() { GoalOutcome::Rejected } else { GoalOutcome::Aborted };
        let end = match end {
            Ok(GoalEnd { outcome: GoalOutcome::Rejected, text, .. }) => {
                let text = if text.is_empty() { "the robot's server did not accept it".to_owned() } else { text };
                action.end_without_result(GoalOutcome::Rejected, text)
            }
            Ok(end) => end,
            Err(error) => action.end_without_result(lost, error.to_string()),
        };
        action.end_goal(&self.id, end);
    }
}

/// Starts the task that gives a goal up which the robot's server does not answer.
fn watch_answer(action: &Arc<LentAction>, id: &str) -> AbortOnDropHandle<()> {
    let (given, id) = (Arc::downgrade(action), id.to_owned());
    let watching = async move {
        sleep(ANSWER).await;
        if let Some(action) = given.upgrade() {
            give_up_goal(&action, &id);
        }
    };
    AbortOnDropHandle::new(action.runtime.spawn(watching.in_current_span()))
}

/// Rejects a goal in the robot's place, which is to cancel it if it accepts it after all.
fn give_up_goal(action: &LentAction, id: &str) {
    action.cancel_goal(id);
    let text = format!("the robot's server did not answer it in {} s", ANSWER.as_secs());
    action.end_goal(id, action.end_without_result(GoalOutcome::Rejected, text));
}
