//! An action that the robot's side serves to the servant's nodes.

use std::sync::Arc;

use bytes::Bytes;
use ros::bus::{ActionHandler, ActionServer, BusError, FailureReason, GoalEnd};

use super::client::ActionCarrier;
use crate::bus::state::Translation;
use crate::{ActionTwin, TranslationError};

/// A server of one action.
pub(super) struct TranslatedActionServer {
    carrier: Arc<ActionCarrier>,
    inner: Box<dyn ActionServer>,
}

impl TranslatedActionServer {
    /// Serves the action in the servant; the handler has the robot's type.
    pub(super) fn open(
        translation: &Arc<Translation>,
        action: &str,
        twin: &Arc<ActionTwin>,
        handler: Arc<dyn ActionHandler>,
    ) -> Result<Box<dyn ActionServer>, BusError> {
        let carrier = Arc::new(ActionCarrier {
            translation: Arc::clone(translation),
            action: action.to_owned(),
            twin: Arc::clone(twin),
        });
        let handler = Arc::new(TranslatingActionHandler { carrier: Arc::clone(&carrier), handler });
        let inner = translation.inner.serve_action(action, &twin.original, handler)?;
        Ok(Box::new(Self { carrier, inner }))
    }
}

impl ActionServer for TranslatedActionServer {
    fn accept_goal(&self, id: &str) {
        self.inner.accept_goal(id);
    }

    fn execute_goal(&self, id: &str) {
        self.inner.execute_goal(id);
    }

    fn publish_feedback(&self, id: &str, feedback: Bytes) -> bool {
        let ActionCarrier { translation, action, twin } = &*self.carrier;
        match translation.losses.translate(action, &twin.feedback.from_twin, &feedback) {
            Ok(feedback) => self.inner.publish_feedback(id, feedback),
            // It was counted, and whether the goal is active is not known.
            Err(_) => true,
        }
    }

    fn end_goal(&self, id: &str, end: GoalEnd) -> bool {
        let twin = &self.carrier.twin;
        let end = self.carrier.carry_end(end, &twin.result.from_twin, &twin.original.result);
        self.inner.end_goal(id, end)
    }
}

/// Gives the goals of the servant's nodes to a handler of the robot's ROS.
struct TranslatingActionHandler {
    carrier: Arc<ActionCarrier>,
    handler: Arc<dyn ActionHandler>,
}

impl ActionHandler for TranslatingActionHandler {
    fn on_goal(&self, id: &str, goal: Bytes) -> Result<(), FailureReason> {
        let ActionCarrier { translation, action, twin } = &*self.carrier;
        let goal = translation.losses.translate(action, &twin.goal.to_twin, &goal);
        let refused =
            |error: TranslationError| FailureReason::new(format!("the goal is not carried to the other ROS: {error}"));
        self.handler.on_goal(id, goal.map_err(refused)?)
    }

    fn is_answer_deferred(&self) -> bool {
        self.handler.is_answer_deferred()
    }

    fn on_cancel(&self, id: &str) {
        self.handler.on_cancel(id);
    }

    fn on_failed(&self, reason: &str) {
        self.handler.on_failed(reason);
    }
}
