//! Ops on actions.

mod answering;
mod goals;
mod sending;
mod server;

use std::collections::HashMap;
use std::sync::Arc;

use ros::bus::RosVersion;
use ros::schema::ActionDef;
use rosbridge::Id;
use tokio_util::sync::CancellationToken;

use super::{BridgeClient, remove_matching};
use crate::lacking::explain_schema_error;
use crate::names::lookup_name;
use goals::ActionClient;
use server::ActionServer;

/// The actions that a client uses and serves.
#[derive(Default)]
pub(super) struct Actions {
    /// Actions it sends goals to, by name.
    used: HashMap<String, Arc<ActionClient>>,
    /// Goals in progress, by the server's id.
    goals: HashMap<String, ActiveGoal>,
    /// Actions it serves, by name.
    served: HashMap<String, Arc<ActionServer>>,
}

/// A goal that can be cancelled.
struct ActiveGoal {
    /// Name of the action.
    action: String,
    /// Id used by the client, for cancelling.
    id: Option<Id<'static>>,
    /// Cancelled before it was sent.
    recalled: CancellationToken,
}

impl Actions {
    /// Removes the served actions whose names match.
    pub(super) fn take_served(
        &mut self,
        chosen: impl Fn(&str) -> bool,
    ) -> Vec<(String, Arc<ActionServer>)> {
        remove_matching(&mut self.served, chosen)
    }

    /// Returns the goals in progress of actions whose names match: the server's id and the action.
    pub(super) fn goals_of_actions(&self, chosen: impl Fn(&str) -> bool) -> Vec<(String, String)> {
        let goals = self.goals.iter().filter(|(_, goal)| chosen(&goal.action));
        goals
            .map(|(goal_id, goal)| (goal_id.clone(), goal.action.clone()))
            .collect()
    }

    /// Returns the server's id of the goal with the client's `id`.
    fn find_goal_id(&self, id: &Id<'_>) -> Option<String> {
        let named = |goal: &ActiveGoal| goal.id.as_ref() == Some(id);
        let mut goals = self.goals.iter();
        goals.find_map(|(goal_id, goal)| named(goal).then(|| goal_id.clone()))
    }
}

impl BridgeClient {
    fn action_def(&self, action: &str, type_name: &str) -> Result<Arc<ActionDef>, String> {
        let name = lookup_name(self.version(), type_name);
        let registry = &self.shared.registry;
        let def = registry.action(&name);
        let def = def.or_else(|error| match name.strip_suffix("Action") {
            // Clients of ROS 1 write NameAction as well as Name.
            Some(short) if self.version() == RosVersion::One => registry.action(short),
            _ => Err(error),
        });
        def.map_err(|error| {
            format!(
                "action {action}: {}",
                explain_schema_error(self.version(), error)
            )
        })
    }
}
