//! `send_action_goal`, `cancel_action_goal` from the client.

use std::sync::{Arc, OnceLock};
use std::time::Instant;

use access::Operation;
use bytes::Bytes;
use ros::bus::BusError;
use ros::codec::Time;
use ros::schema::ActionDef;
use rosbridge::{CancelActionGoal, Compression, Format, SendActionGoal};
use tokio_util::sync::CancellationToken;

use super::UnderWayGoal;
use super::goals::{ActionClient, Goal};
use crate::client::decoding::decode_args;
use crate::client::{Client, Reply};
use crate::names::other_type;
use crate::tf;

/// A goal that was read and is to be sent.
struct Prepared {
    action: Arc<ActionClient>,
    name: String,
    goal_id: String,
    body: Bytes,
    recalled: CancellationToken,
}

impl Client {
    pub(in crate::client) fn send_action_goal(
        self: &Arc<Self>,
        op: SendActionGoal<'_>,
        reply: &Reply,
    ) -> Result<(), String> {
        self.shared.metrics.goals.add(1);
        let compression = op.compression.unwrap_or(match reply.format {
            Format::Json => Compression::None,
            Format::Cbor => Compression::Cbor,
        });
        if let Some(id) = &reply.id
            && self.actions.lock().goal_of(id).is_some()
        {
            return Err(format!("a goal with id {id} is under way already"));
        }
        let goal = Goal {
            client: Arc::downgrade(self),
            action: op.action.clone().into_owned(),
            id: reply.id.clone(),
            feedback: op.feedback,
            compression,
            fragment_size: op.fragment_size,
            goal_id: String::new(),
            begun: None,
            sent: OnceLock::new(),
        };
        let prepared = self.begin(op.args).and_then(|guard| {
            let prepared = self.prepare_goal(&op, reply, compression)?;
            Ok((prepared, guard))
        });
        match prepared {
            Ok((prepared, guard)) => {
                let goal = Goal {
                    goal_id: prepared.goal_id.clone(),
                    begun: Some((prepared.action.def.clone(), guard)),
                    ..goal
                };
                let known = UnderWayGoal {
                    action: prepared.name.clone(),
                    id: goal.id.clone(),
                    recalled: prepared.recalled.clone(),
                };
                let mut actions = self.actions.lock();
                actions.goals.insert(prepared.goal_id.clone(), known);
                drop(actions);
                tokio::spawn(run_goal(prepared, Arc::new(goal)));
            }
            Err(reason) => goal.fail(&reason),
        }
        Ok(())
    }

    fn prepare_goal(
        self: &Arc<Self>,
        op: &SendActionGoal<'_>,
        reply: &Reply,
        compression: Compression,
    ) -> Result<Prepared, String> {
        let name = self.resolve(&op.action)?.into_owned();
        self.granted().check(Operation::Call, &name)?;
        let def = self.action_def(&name, &op.action_type)?;
        self.report_surplus(reply, "send_action_goal", &def.goal, op.args);
        let body = decode_args(&def.goal, op.args, compression)?;
        let action = self.action_client(&name, def)?;
        // As actionlib makes them: another node's, or one that has the same name later, makes no equal ones.
        let now = Time::now();
        let goal_id = format!(
            "{}-{}-{}.{:09}",
            self.shared.bus.node(),
            self.shared.next_number(),
            now.secs,
            now.nsecs
        );
        Ok(Prepared {
            action,
            name,
            goal_id,
            body,
            recalled: CancellationToken::new(),
        })
    }

    fn action_client(
        self: &Arc<Self>,
        name: &str,
        def: Arc<ActionDef>,
    ) -> Result<Arc<ActionClient>, String> {
        let limit = self.shared.options.max_advertisements;
        let mut actions = self.actions.lock();
        if let Some(known) = actions.used.get(name) {
            if known.def.name == def.name {
                return Ok(known.clone());
            }
        } else if actions.used.len() >= limit {
            return Err(format!("this client uses {limit} actions already"));
        }
        let bus = match tf::own_action(&self.shared, name, &def) {
            Some(own) => own,
            None => {
                let opened = self.shared.bus.action_client(name, &def);
                opened.map_err(|error| error.to_string())?
            }
        };
        let action = Arc::new(ActionClient { def, bus });
        let replaced = actions.used.insert(name.to_owned(), action.clone());
        drop(actions);
        drop(replaced);
        Ok(action)
    }

    pub(in crate::client) fn cancel_action_goal(
        &self,
        op: &CancelActionGoal<'_>,
    ) -> Result<(), String> {
        let goal_id = self.actions.lock().goal_of(&op.id);
        match goal_id.is_some_and(|goal_id| self.cancel_goal(&goal_id)) {
            true => Ok(()),
            false => Err(format!("no goal with id {} is under way", op.id)),
        }
    }

    /// Cancels a goal by its server's name for it; false where it is not under way.
    pub(in crate::client) fn cancel_goal(&self, goal_id: &str) -> bool {
        let actions = self.actions.lock();
        let Some(goal) = actions.goals.get(goal_id) else {
            return false;
        };
        let Some(action) = actions.used.get(&goal.action).cloned() else {
            return true;
        };
        let recalled = goal.recalled.clone();
        drop(actions);
        // One that still waits for its server need not be sent at all; `run_goal` looks at this last of all.
        recalled.cancel();
        action.bus.cancel(goal_id);
        true
    }
}

/// Sends a goal when its server is there.
async fn run_goal(prepared: Prepared, goal: Arc<Goal>) {
    let Prepared {
        action,
        name,
        goal_id,
        body,
        recalled,
    } = prepared;
    let Some((patience, ended)) = goal.client.upgrade().map(|client| {
        let patience = client.shared.options.action_timeout;
        (patience, client.ended.clone())
    }) else {
        return;
    };
    let ready = tokio::select! {
        () = ended.cancelled() => return,
        () = recalled.cancelled() => return goal.recalled(),
        ready = action.bus.ready(patience) => ready,
    };
    match ready {
        Ok(()) => {}
        Err(BusError::Timeout { .. }) => {
            let text = format!("action server {name} did not connect within {patience:?}");
            return goal.fail(&text);
        }
        Err(BusError::TypeMismatch { theirs, ours, .. }) => {
            let action = format!("action {name}");
            return goal.fail(&other_type(&action, &theirs, &ours));
        }
        Err(error) => return goal.fail(&error.to_string()),
    }
    // What the robot's own clients serve says nothing of the servant.
    let own = goal.client.upgrade().is_some_and(|client| {
        let bus = &client.shared.bus;
        let graph = bus.graph().borrow().clone();
        let nodes = graph.actions.get(&name);
        nodes.is_some_and(|nodes| nodes.servers.iter().any(|node| node == bus.node()))
    });
    if !own {
        let _ = goal.sent.set(Instant::now());
    }
    action.bus.send(&goal_id, body, goal);
    // Cancelled while it was being sent.
    if recalled.is_cancelled() {
        action.bus.cancel(&goal_id);
    }
}
