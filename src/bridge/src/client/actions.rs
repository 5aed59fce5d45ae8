//! Ops on actions.

mod answering;
mod goals;
mod sending;
mod server;

use std::sync::Arc;

use ros::bus::{BusError, RosVersion};
use ros::schema::ActionDef;
use rosbridge::Id;

use super::decoding::PayloadError;
use super::under_way::BeginCallError;
use super::{BridgeClient, remove_matching};
use crate::NotGrantedError;
use crate::client_state::{ActionServer, Actions, ActiveGoal};
use crate::lacking::DefinitionError;
use crate::names::{ResolveNameError, lookup_name};

/// Reasons why an operation on an action or goal is refused.
#[derive(Debug, thiserror::Error)]
pub(super) enum ClientActionError {
    #[error(transparent)]
    Name(#[from] ResolveNameError),
    #[error(transparent)]
    NotGranted(#[from] NotGrantedError),
    #[error("action {action}: {source}")]
    Definition { action: String, source: DefinitionError },
    #[error(transparent)]
    Begin(#[from] BeginCallError),
    /// The goal, feedback or result is not a message of its type.
    #[error(transparent)]
    Payload(#[from] PayloadError),
    /// The action cannot be used or served.
    #[error(transparent)]
    Bus(#[from] BusError),
    #[error("this client uses {0} actions already")]
    TooManyUsed(usize),
    #[error("this client serves {0} actions already; unadvertise one")]
    TooManyServed(usize),
    #[error("a goal with id {0} is under way already")]
    DuplicateGoal(Id<'static>),
    #[error("no goal with id {0} is under way")]
    NoSentGoal(Id<'static>),
    #[error("action {0} is not advertised by this client; advertise_action it first")]
    NotAdvertised(String),
    #[error("field \"id\" is missing, the goal's id is expected")]
    NoId,
    #[error("action {action} has no goal with id {request:?} under way")]
    NoServedGoal { action: String, request: String },
}

impl Actions {
    /// Removes the served actions whose names match.
    pub(super) fn take_served(&mut self, chosen: impl Fn(&str) -> bool) -> Vec<(String, Arc<ActionServer>)> {
        remove_matching(&mut self.served, chosen)
    }

    /// Returns the goals in progress of actions whose names match: the server's id and the action.
    pub(super) fn goals_of_actions(&self, chosen: impl Fn(&str) -> bool) -> Vec<(String, String)> {
        let goals = self.goals.iter().filter(|(_, goal)| chosen(&goal.action));
        goals.map(|(goal_id, goal)| (goal_id.clone(), goal.action.clone())).collect()
    }

    /// Returns the server's id of the goal with the client's `id`.
    fn find_goal_id(&self, id: &Id<'_>) -> Option<String> {
        let named = |goal: &ActiveGoal| goal.id.as_ref() == Some(id);
        let mut goals = self.goals.iter();
        goals.find_map(|(goal_id, goal)| named(goal).then(|| goal_id.clone()))
    }
}

impl BridgeClient {
    fn action_def(&self, action: &str, type_name: &str) -> Result<Arc<ActionDef>, ClientActionError> {
        let name = lookup_name(self.version(), type_name);
        let registry = &self.shared.registry;
        let def = registry.action(&name);
        let def = def.or_else(|error| match name.strip_suffix("Action") {
            // Clients of ROS 1 write NameAction as well as Name.
            Some(short) if self.version() == RosVersion::One => registry.action(short),
            _ => Err(error),
        });
        def.map_err(|error| ClientActionError::Definition {
            action: action.to_owned(),
            source: DefinitionError::new(self.version(), error),
        })
    }
}
