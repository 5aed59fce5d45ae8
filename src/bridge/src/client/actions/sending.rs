//! `send_action_goal`, `cancel_action_goal` from the client.

use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use bytes::Bytes;
use ros::bus::Graph;
use ros::codec::Time;
use ros::schema::ActionDef;
use rosbridge::{CancelActionGoal, Compression, Format, SendActionGoal};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use super::UnderWayGoal;
use super::goals::{ActionClient, Goal};
use crate::actionlib::{self, GoalId};
use crate::client::publishing::decode_args;
use crate::client::{Client, Reply};
use crate::names::resolve;

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
            && self.actions.lock().goals.contains_key(id)
        {
            return Err(format!("a goal with id {id} is under way already"));
        }
        let goal = Goal {
            action: op.action.clone().into_owned(),
            id: reply.id.clone(),
            feedback: op.feedback,
            compression,
            fragment_size: op.fragment_size,
            seen: Instant::now(),
            done: Arc::default(),
            _under_way: None,
        };
        let prepared = self.begin(op.args).and_then(|guard| {
            let prepared = self.prepare_goal(&op, reply, compression)?;
            Ok((prepared, guard))
        });
        match prepared {
            Ok((prepared, guard)) => {
                let goal = Goal {
                    _under_way: Some(guard),
                    ..goal
                };
                if let Some(id) = &goal.id {
                    let known = UnderWayGoal {
                        action: prepared.name.clone(),
                        goal_id: prepared.goal_id.clone(),
                        recalled: prepared.recalled.clone(),
                    };
                    self.actions.lock().goals.insert(id.clone(), known);
                }
                tokio::spawn(run_goal(Arc::downgrade(self), prepared, goal));
            }
            Err(reason) => goal.fail(self, &reason),
        }
        Ok(())
    }

    fn prepare_goal(
        self: &Arc<Self>,
        op: &SendActionGoal<'_>,
        reply: &Reply,
        compression: Compression,
    ) -> Result<Prepared, String> {
        let name = resolve(&op.action)?.into_owned();
        let def = self.action_def(&name, &op.action_type)?;
        self.tell_surplus(reply, "send_action_goal", &def.goal, op.args);
        let body = decode_args(&def.goal, op.args, compression)?;
        let action = self.action_client(&name, def)?;
        let goal_id = format!(
            "cloudroid-{}-{}",
            self.shared.next_number(),
            Time::now().secs
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
        let action = ActionClient::open(self, name, def)?;
        let replaced = actions.used.insert(name.to_owned(), action.clone());
        drop(actions);
        drop(replaced);
        Ok(action)
    }

    pub(in crate::client) fn cancel_action_goal(
        &self,
        op: &CancelActionGoal<'_>,
    ) -> Result<(), String> {
        let id = op.id.clone().into_owned();
        let actions = self.actions.lock();
        let Some(goal) = actions.goals.get(&id) else {
            return Err(format!("no goal with id {id} is under way"));
        };
        let Some(action) = actions.used.get(&goal.action).cloned() else {
            return Ok(());
        };
        let (goal_id, recalled) = (goal.goal_id.clone(), goal.recalled.clone());
        drop(actions);
        // One that still waits for its server need not be sent at all; `run_goal` looks at this last of all.
        recalled.cancel();
        if action.goals.lock().contains_key(&goal_id) {
            action.cancel(&goal_id);
        }
        Ok(())
    }
}

/// Sends a goal when its server is there, and sees to it that it is answered.
async fn run_goal(client: Weak<Client>, prepared: Prepared, goal: Goal) {
    let Prepared {
        action,
        name,
        goal_id,
        body,
        recalled,
    } = prepared;
    let Some((patience, ended, graph)) = client.upgrade().map(|client| {
        let graph = client.shared.bus.graph();
        (
            client.shared.options.action_timeout,
            client.ended.clone(),
            graph,
        )
    }) else {
        return;
    };
    let there = tokio::select! {
        () = ended.cancelled() => return,
        () = recalled.cancelled() => {
            if let Some(client) = client.upgrade() {
                goal.recalled(&client, &action.def);
            }
            return;
        }
        there = tokio::time::timeout(patience, action.connected()) => there,
    };
    if there.is_err() && !action.goal.has_subscriber() && !action.is_local() {
        if let Some(client) = client.upgrade() {
            goal.fail(
                &client,
                &format!("action server {name} did not connect within {patience:?}"),
            );
        }
        return;
    }
    let done = goal.done.clone();
    let now = Time::now();
    let goal = Goal {
        seen: Instant::now(),
        ..goal
    };
    let known_in_time = {
        let mut goals = action.goals.lock();
        goals.insert(goal_id.clone(), goal);
        !recalled.is_cancelled()
    };
    action.goal.publish(actionlib::write_goal(
        now,
        &GoalId {
            stamp: now,
            id: goal_id.clone(),
        },
        &body,
    ));
    // Cancelled while it was being sent.
    if !known_in_time {
        action.cancel(&goal_id);
    }
    let gone = server_gone(graph, format!("{name}/result"));
    tokio::select! {
        () = ended.cancelled() => {}
        () = done.notified() => {}
        () = gone => {
            let goal = action.goals.lock().remove(&goal_id);
            if let (Some(client), Some(goal)) = (client.upgrade(), goal) {
                goal.fail(&client, &format!("action server {name} is gone"));
            }
        }
    }
}

/// Ready when nobody has published on the topic for a while.
async fn server_gone(mut graph: watch::Receiver<Arc<Graph>>, topic: String) {
    const PATIENCE: Duration = Duration::from_secs(3);
    let nobody = |graph: &Arc<Graph>| {
        graph
            .topics
            .get(&topic)
            .is_none_or(|nodes| nodes.publishers.is_empty())
    };
    loop {
        if graph.wait_for(nobody).await.is_err() {
            return;
        }
        let back = graph.wait_for(|graph| !nobody(graph));
        if tokio::time::timeout(PATIENCE, back).await.is_err() {
            return;
        }
    }
}
