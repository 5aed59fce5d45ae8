//! The ops on actions.

mod answering;
mod goals;
mod sending;
mod server;

use std::collections::HashMap;
use std::sync::Arc;

use ros::schema::ActionDef;
use rosbridge::Id;
use tokio_util::sync::CancellationToken;

use super::{Client, take_chosen};
use crate::lacking::explain;
use crate::names::plain_type;
use goals::ActionClient;
use server::ActionServer;

/// The actions a client uses and serves.
#[derive(Default)]
pub(super) struct Actions {
    /// Those it sends goals to, by action name.
    used: HashMap<String, Arc<ActionClient>>,
    /// Goals under way, by the id the client gave.
    goals: HashMap<Id<'static>, UnderWayGoal>,
    /// Those it serves, by action name.
    served: HashMap<String, Arc<ActionServer>>,
}

/// A goal that the client can cancel.
struct UnderWayGoal {
    /// The action's name.
    action: String,
    /// What the server calls it.
    goal_id: String,
    /// Cancelled before it was sent.
    recalled: CancellationToken,
}

impl Actions {
    /// Removes those of these names that the client serves.
    pub(super) fn take_served(
        &mut self,
        chosen: impl Fn(&str) -> bool,
    ) -> Vec<(String, Arc<ActionServer>)> {
        take_chosen(&mut self.served, chosen)
    }

    /// Goals under way at actions of these names, with those.
    pub(super) fn goals_at(&self, chosen: impl Fn(&str) -> bool) -> Vec<(Id<'static>, String)> {
        let goals = self.goals.iter().filter(|(_, goal)| chosen(&goal.action));
        goals
            .map(|(id, goal)| (id.clone(), goal.action.clone()))
            .collect()
    }
}

impl Client {
    fn action_def(&self, action: &str, type_name: &str) -> Result<Arc<ActionDef>, String> {
        let name = plain_type(type_name);
        let registry = &self.shared.registry;
        // ROS 1 clients write NameAction as well as Name.
        let def = registry
            .action(&name)
            .or_else(|error| match name.strip_suffix("Action") {
                Some(short) => registry.action(short),
                None => Err(error),
            });
        def.map_err(|error| format!("action {action}: {}", explain(error)))
    }
}
