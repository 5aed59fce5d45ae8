//! Actions: goals that take time, tell how they get on, and can be cancelled.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;

use super::{BusError, Graph};

/// How a goal ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// Its result is what was asked for.
    Succeeded,
    /// Its sender, or somebody else, wanted it to end.
    Canceled,
    /// It failed.
    Aborted,
    /// It was never begun: its server did not take it.
    Rejected,
    /// Its server says something that this ROS does not define.
    Unknown,
}

/// The end of a goal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GoalEnd {
    /// How it ended.
    pub outcome: Outcome,
    /// What its server says of that; may be empty.
    pub text: String,
    /// The serialized result.
    pub result: Bytes,
}

/// Hears how one goal gets on, in order. Must not block.
pub trait GoalEvents: Send + Sync + 'static {
    /// Its server has taken it. Told of where servers answer that (ROS 2), and not of a goal that was rejected.
    fn accepted(&self) {}
    /// Its server has answered a wish that it should end: whether it does. Told of as `accepted` is.
    fn cancel_answered(&self, _ends: bool) {}
    /// Serialized feedback.
    fn feedback(&self, feedback: Bytes);
    /// It has ended, or the reason why nobody will ever know. The last event.
    fn ended(&self, end: Result<GoalEnd, String>);
}

/// An action that this side sends goals to; dropping it cancels those under way.
#[async_trait]
pub trait ActionClient: Send + Sync {
    /// Returns once a server takes goals and what it answers will be heard; with [`BusError::TypeMismatch`] at once where the
    /// servers that there are have another type.
    async fn ready(&self, patience: Duration) -> Result<(), BusError>;
    /// Sends a serialized goal. No other goal of this bus may have the same id.
    fn send(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>);
    /// Asks the server to end a goal; nothing where it has ended.
    fn cancel(&self, id: &str);
}

/// Carries out the goals of one action that this side serves. Must not block.
pub trait ActionHandler: Send + Sync + 'static {
    /// A goal has come; an error refuses it.
    fn goal(&self, id: &str, goal: Bytes) -> Result<(), String>;
    /// A goal that was taken should end.
    fn cancel(&self, id: &str);
    /// The action cannot be served.
    fn failed(&self, reason: &str);
}

/// An action that this side serves; dropping it aborts the goals under way.
pub trait ActionServer: Send + Sync {
    /// Tells how a goal gets on; false where there is none of this id under way.
    fn feedback(&self, id: &str, feedback: Bytes) -> bool;
    /// Ends a goal; false where there is none of this id under way.
    fn end(&self, id: &str, end: GoalEnd) -> bool;
}

impl Graph {
    /// That the servers of an action have another type than this one, where the graph says so.
    pub fn other_action(&self, action: &str, ours: &str) -> Option<BusError> {
        let nodes = self.actions.get(action)?;
        let is_other = !matches!(nodes.type_name.as_str(), "" | "*") && nodes.type_name != ours;
        (is_other && !nodes.servers.is_empty()).then(|| BusError::TypeMismatch {
            what: format!("action {action}"),
            theirs: nodes.type_name.clone(),
            ours: ours.to_owned(),
        })
    }
}
