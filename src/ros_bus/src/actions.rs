//! Actions: long-running goals with feedback that can be cancelled.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;

use super::{BusError, FailureReason, Graph};

/// Outcome of a goal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GoalOutcome {
    /// The goal was reached; its result is valid.
    Succeeded,
    /// The goal was cancelled, by its client or by another node.
    Canceled,
    /// The goal failed.
    Aborted,
    /// The server did not accept the goal; it never ran.
    Rejected,
    /// The server reported a status that this ROS version does not define.
    Unknown,
}

/// The end of a goal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GoalEnd {
    /// The outcome.
    pub outcome: GoalOutcome,
    /// Status text from the server; may be empty.
    pub text: String,
    /// The serialized result.
    pub result: Bytes,
}

/// The reason why the end of a goal will never be known.
#[derive(Debug, Clone, thiserror::Error)]
pub enum GoalError {
    /// The bytes are no message of the action's goal type.
    #[error("the goal is not a serialized {0}")]
    NotAGoal(
        /// Name of the goal type.
        String,
    ),
    /// Another goal of this bus has the id and has not ended.
    #[error("a goal with id {0} is under way already")]
    AlreadyUnderWay(String),
    /// The topics of the action are not open.
    #[error("action {0} is not ready")]
    NotReady(String),
    /// No node serves the action.
    #[error("action {0} has no server")]
    NoServer(String),
    /// The server went away while it had the goal.
    #[error("action server {0} is gone")]
    ServerGone(String),
    /// The server does not list the goal any more.
    #[error("the action server no longer knows the goal")]
    Forgotten,
    /// The server's answer to the goal does not have the action's type.
    #[error("action {0} sent an answer that cannot be read")]
    UnreadableAnswer(String),
    /// The result does not have the action's type.
    #[error("the result of action {0} cannot be read")]
    UnreadableResult(String),
    /// The bus failed, or was closed.
    #[error(transparent)]
    Bus(Arc<BusError>),
    /// The goal was given up on its way to a server, or without one, for this reason.
    #[error(transparent)]
    GivenUp(FailureReason),
}

impl From<BusError> for GoalError {
    fn from(error: BusError) -> Self {
        Self::Bus(Arc::new(error))
    }
}

/// Callbacks for one goal, called in order. Must not block.
///
/// Servers of ROS 2 answer a goal and a cancel request. Those of ROS 1 list the goal's status instead, in which both
/// are seen with a delay, or not at all if the goal ends before.
pub trait GoalEvents: Send + Sync + 'static {
    /// The goal waits: the server lists it as pending (ROS 1), or no servant of a group is free for it.
    fn on_waiting(&self) {}
    /// The server accepted the goal, or lists it as active (ROS 1). Not called for a rejected goal.
    fn on_accepted(&self) {}
    /// The server answered a cancel request; the argument tells whether it will cancel the goal. Servers of ROS 1 do
    /// not refuse: it is called once such a server lists the goal as being cancelled, whoever asked for it.
    fn on_cancel_response(&self, _ends: bool) {}
    /// Serialized feedback arrived.
    fn on_feedback(&self, feedback: Bytes);
    /// The goal ended, or its end will never be known. This is the last event.
    fn on_ended(&self, end: Result<GoalEnd, GoalError>);
}

/// A client of an action; dropping it cancels its active goals.
#[async_trait]
pub trait ActionClient: Send + Sync {
    /// Waits until a server accepts goals and its responses will reach this client. Fails at once with
    /// [`BusError::TypeMismatch`] if the existing servers have another type.
    async fn wait_for_server(&self, patience: Duration) -> Result<(), BusError>;
    /// Sends a serialized goal. The id must be unique among the goals of this bus.
    fn send_goal(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>);
    /// Asks the server to cancel a goal; does nothing if the goal has ended.
    fn cancel_goal(&self, id: &str);
}

/// Executes the goals of one action that this bus serves. Must not block.
pub trait ActionHandler: Send + Sync + 'static {
    /// A goal arrived; an error rejects it.
    fn on_goal(&self, id: &str, goal: Bytes) -> Result<(), FailureReason>;
    /// Returns whether goals that `on_goal` did not reject are accepted only later, by [`ActionServer::accept_goal`] or
    /// [`ActionServer::execute_goal`], or rejected, by [`ActionServer::end_goal`].
    fn is_answer_deferred(&self) -> bool {
        false
    }
    /// An accepted goal is to be cancelled.
    fn on_cancel(&self, id: &str);
    /// The action cannot be served.
    fn on_failed(&self, reason: &str);
}

/// An action that this bus serves; dropping it aborts the active goals.
pub trait ActionServer: Send + Sync {
    /// Accepts a goal whose answer was deferred, and which waits to be executed.
    fn accept_goal(&self, id: &str);
    /// Reports that such a goal is executed, and accepts it unless that was done before.
    fn execute_goal(&self, id: &str);
    /// Publishes feedback for a goal; returns false if no goal with this id is active.
    fn publish_feedback(&self, id: &str, feedback: Bytes) -> bool;
    /// Ends a goal; returns false if no goal with this id is active.
    fn end_goal(&self, id: &str, end: GoalEnd) -> bool;
}

impl Graph {
    /// Returns the type mismatch if the graph shows servers of the action with another type than `ours`.
    pub fn action_type_mismatch(&self, action: &str, ours: &str) -> Option<BusError> {
        let nodes = self.actions.get(action)?;
        let is_other = !matches!(nodes.type_name.as_str(), "" | "*") && nodes.type_name != ours;
        (is_other && !nodes.servers.is_empty()).then(|| BusError::TypeMismatch {
            what: format!("action {action}"),
            theirs: nodes.type_name.clone(),
            ours: ours.to_owned(),
        })
    }
}
