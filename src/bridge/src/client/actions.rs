//! The ops on actions.

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

use super::{Client, take_chosen};
use crate::lacking::explain;
use crate::names::sought;
use goals::ActionClient;
use server::ActionServer;

/// The actions a client uses and serves.
#[derive(Default)]
pub(super) struct Actions {
    /// Those it sends goals to, by action name.
    used: HashMap<String, Arc<ActionClient>>,
    /// Goals under way, by what the server calls them.
    goals: HashMap<String, UnderWayGoal>,
    /// Those it serves, by action name.
    served: HashMap<String, Arc<ActionServer>>,
}

/// A goal that can be cancelled.
struct UnderWayGoal {
    /// The action's name.
    action: String,
    /// What the client calls it, by which it cancels it.
    id: Option<Id<'static>>,
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

    /// Goals under way at actions of these names, as their servers call them, with those.
    pub(super) fn goals_at(&self, chosen: impl Fn(&str) -> bool) -> Vec<(String, String)> {
        let goals = self.goals.iter().filter(|(_, goal)| chosen(&goal.action));
        goals
            .map(|(goal_id, goal)| (goal_id.clone(), goal.action.clone()))
            .collect()
    }

    /// What the server calls the goal that the client calls `id`.
    fn goal_of(&self, id: &Id<'_>) -> Option<String> {
        let named = |goal: &UnderWayGoal| goal.id.as_ref() == Some(id);
        let mut goals = self.goals.iter();
        goals.find_map(|(goal_id, goal)| named(goal).then(|| goal_id.clone()))
    }
}

impl Client {
    fn action_def(&self, action: &str, type_name: &str) -> Result<Arc<ActionDef>, String> {
        let name = sought(self.version(), type_name);
        let registry = &self.shared.registry;
        let def = registry.action(&name);
        let def = def.or_else(|error| match name.strip_suffix("Action") {
            // Clients of ROS 1 write NameAction as well as Name.
            Some(short) if self.version() == RosVersion::One => registry.action(short),
            _ => Err(error),
        });
        def.map_err(|error| format!("action {action}: {}", explain(self.version(), error)))
    }
}
