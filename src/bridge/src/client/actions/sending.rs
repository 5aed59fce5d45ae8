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

use super::goals::SentGoal;
use super::{ActiveGoal, ClientActionError};
use crate::client::decoding::decode_args;
use crate::client::{BridgeClient, ReplyTarget};
use crate::client_state::ActionClient;
use crate::names::DeclaredTypeError;
use crate::tf;

/// A goal that is ready to be sent.
struct PreparedGoal {
    action: Arc<ActionClient>,
    name: String,
    goal_id: String,
    body: Bytes,
    recalled: CancellationToken,
}

impl BridgeClient {
    pub(in crate::client) fn send_action_goal(
        self: &Arc<Self>,
        op: SendActionGoal<'_>,
        reply: &ReplyTarget,
    ) -> Result<(), ClientActionError> {
        self.shared.metrics.goals.add(1);
        let compression = op.compression.unwrap_or(match reply.format {
            Format::Json => Compression::None,
            Format::Cbor => Compression::Cbor,
        });
        if let Some(id) = &reply.id
            && self.actions.lock().find_goal_id(id).is_some()
        {
            return Err(ClientActionError::DuplicateGoal(id.clone()));
        }
        let goal = SentGoal {
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
        let begun = self.begin_call(op.args).map_err(ClientActionError::from);
        let prepared = begun.and_then(|guard| {
            let prepared = self.prepare_goal(&op, reply, compression)?;
            Ok((prepared, guard))
        });
        match prepared {
            Ok((prepared, guard)) => {
                let goal = SentGoal {
                    goal_id: prepared.goal_id.clone(),
                    begun: Some((prepared.action.def.clone(), guard)),
                    ..goal
                };
                let known = ActiveGoal {
                    action: prepared.name.clone(),
                    id: goal.id.clone(),
                    recalled: prepared.recalled.clone(),
                };
                let mut actions = self.actions.lock();
                actions.goals.insert(prepared.goal_id.clone(), known);
                drop(actions);
                tokio::spawn(run_goal(prepared, Arc::new(goal)));
            }
            Err(error) => goal.fail(&error.to_string()),
        }
        Ok(())
    }

    fn prepare_goal(
        self: &Arc<Self>,
        op: &SendActionGoal<'_>,
        reply: &ReplyTarget,
        compression: Compression,
    ) -> Result<PreparedGoal, ClientActionError> {
        let name = self.resolve(&op.action)?.into_owned();
        self.client_grants().check(Operation::Call, &name)?;
        let def = self.action_def(&name, &op.action_type)?;
        self.warn_surplus_args(reply, "send_action_goal", &def.goal, op.args);
        let body = decode_args(&def.goal, op.args, compression)?;
        let body = self.take_decoded(body, "send_action_goal", ("action", &name), reply);
        let action = self.action_client(&name, def)?;
        // In the format of actionlib: neither another node nor a later one of the same name makes equal ids.
        let now = Time::now();
        let goal_id = format!("{}-{}-{}.{:09}", self.shared.bus.node(), self.shared.next_number(), now.secs, now.nsecs);
        Ok(PreparedGoal { action, name, goal_id, body, recalled: CancellationToken::new() })
    }

    fn action_client(
        self: &Arc<Self>,
        name: &str,
        def: Arc<ActionDef>,
    ) -> Result<Arc<ActionClient>, ClientActionError> {
        let limit = self.shared.options.max_advertisements;
        let mut actions = self.actions.lock();
        if let Some(known) = actions.used.get(name) {
            if known.def.name == def.name {
                return Ok(known.clone());
            }
        } else if actions.used.len() >= limit {
            return Err(ClientActionError::TooManyUsed(limit));
        }
        let bus = match tf::own_action_client(&self.shared, name, &def) {
            Some(own) => own,
            None => self.shared.bus.action_client(name, &def)?,
        };
        let action = Arc::new(ActionClient { def, bus });
        let replaced = actions.used.insert(name.to_owned(), action.clone());
        drop(actions);
        drop(replaced);
        Ok(action)
    }

    pub(in crate::client) fn cancel_action_goal(&self, op: &CancelActionGoal<'_>) -> Result<(), ClientActionError> {
        let goal_id = self.actions.lock().find_goal_id(&op.id);
        if goal_id.is_some_and(|goal_id| self.cancel_goal(&goal_id)) {
            Ok(())
        } else {
            Err(ClientActionError::NoSentGoal(op.id.clone().into_owned()))
        }
    }

    /// Cancels a goal by the server's id; returns false if it is not in progress.
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
        // A goal that still waits for its server need not be sent at all; `run_goal` checks this last.
        recalled.cancel();
        action.bus.cancel_goal(goal_id);
        true
    }
}

/// Sends a goal when its server is available.
async fn run_goal(prepared: PreparedGoal, goal: Arc<SentGoal>) {
    let PreparedGoal { action, name, goal_id, body, recalled } = prepared;
    let Some((patience, ended)) = goal.client.upgrade().map(|client| {
        let patience = client.shared.options.action_timeout;
        (patience, client.ended.clone())
    }) else {
        return;
    };
    let ready = tokio::select! {
        () = ended.cancelled() => return,
        () = recalled.cancelled() => return goal.answer_recalled(),
        ready = action.bus.wait_for_server(patience) => ready,
    };
    match ready {
        Ok(()) => {}
        Err(BusError::Timeout { .. }) => {
            let text = format!("action server {name} did not connect within {patience:?}");
            return goal.fail(&text);
        }
        Err(BusError::TypeMismatch { theirs, ours, .. }) => {
            let error = DeclaredTypeError::new(format!("action {name}"), &theirs, &ours);
            return goal.fail(&error.to_string());
        }
        Err(error) => return goal.fail(&error.to_string()),
    }
    // Services of the robot's own clients say nothing about the servant.
    let own = goal.client.upgrade().is_some_and(|client| {
        let bus = &client.shared.bus;
        let graph = bus.graph().borrow().clone();
        let nodes = graph.actions.get(&name);
        nodes.is_some_and(|nodes| nodes.servers.iter().any(|node| node == bus.node()))
    });
    if !own {
        let _ = goal.sent.set(Instant::now());
    }
    action.bus.send_goal(&goal_id, body, goal);
    // Cancelled while it was being sent.
    if recalled.is_cancelled() {
        action.bus.cancel_goal(&goal_id);
    }
}
