//! `send_action_goal`, `cancel_action_goal` from the client: it is an action client.

use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use bytes::Bytes;
use parking_lot::Mutex;
use ros::codec::Time;
use ros::schema::{ActionDef, MessageType};
use rosbridge::{CancelActionGoal, Compression, Format, GoalStatus, Id, SendActionGoal, Writer};
use tokio::sync::{Notify, watch};

use super::{common_type, is_type};
use crate::actionlib::{self, GoalId, Status};
use crate::client::publishing::decode_args;
use crate::client::{Client, Reply, UnderWay, print_format};
use crate::hub::{Listener, Listening};
use crate::names::resolve;
use crate::outlet::Outlet;
use crate::sample::{Frame, Sample};

/// A goal that the server has stopped speaking of is lost.
const LOST_AFTER: Duration = Duration::from_secs(5);
/// Feedback is left out while so many answers wait.
const FEEDBACK_WAITS: usize = 256;

/// One action that a client sends goals to.
pub(super) struct ActionClient {
    def: Arc<ActionDef>,
    goal: Arc<Outlet>,
    cancel: Arc<Outlet>,
    goals: Mutex<HashMap<String, Goal>>,
    /// Whether the server's status has been heard: it is connected then.
    heard: watch::Sender<bool>,
    /// Set once, right after it was made: the listeners need the client itself.
    listening: Mutex<Vec<Listening>>,
    client: Weak<Client>,
}

struct Goal {
    /// As the client wrote it.
    action: String,
    id: Option<Id<'static>>,
    feedback: bool,
    compression: Compression,
    fragment_size: Option<usize>,
    /// When the server last spoke of it.
    seen: Instant,
    done: Arc<Notify>,
    _under_way: UnderWay,
}

/// A goal that was read and is to be sent.
struct Prepared {
    action: Arc<ActionClient>,
    name: String,
    goal_id: String,
    body: Bytes,
}

#[derive(Clone, Copy, PartialEq)]
enum Topic {
    Feedback,
    Result,
    Status,
}

struct TopicListener {
    action: Weak<ActionClient>,
    topic: Topic,
    expected: Arc<MessageType>,
}

impl Listener for TopicListener {
    fn sample(&self, sample: &Arc<Sample>, _replay: bool) {
        let Some(action) = self.action.upgrade() else { return };
        if !is_type(&sample.wire_type, &self.expected) {
            return;
        }
        match self.topic {
            Topic::Feedback => action.feedback(&sample.bytes),
            Topic::Result => action.result(&sample.bytes),
            Topic::Status => action.status(&sample.bytes),
        }
    }

    fn failed(&self, reason: &str) {
        if let Some(action) = self.action.upgrade() {
            action.fail_all(reason);
        }
    }
}

impl ActionClient {
    fn open(client: &Arc<Client>, name: &str, def: Arc<ActionDef>) -> Result<Arc<Self>, String> {
        let shared = &client.shared;
        let goal_id = common_type(shared, "actionlib_msgs/GoalID")?;
        let states = common_type(shared, "actionlib_msgs/GoalStatusArray")?;
        let action = Arc::new(Self {
            goal: client.action_outlet(format!("{name}/goal"), &def.action_goal, false),
            cancel: client.action_outlet(format!("{name}/cancel"), &goal_id, false),
            goals: Mutex::default(),
            heard: watch::Sender::default(),
            listening: Mutex::default(),
            client: Arc::downgrade(client),
            def: def.clone(),
        });
        let listen = |part: &str, topic, expected: &Arc<MessageType>| {
            let listener = TopicListener { action: Arc::downgrade(&action), topic, expected: expected.clone() };
            shared.hub(&format!("{name}/{part}"), Some(expected)).listen(Arc::new(listener))
        };
        let listening = vec![
            listen("feedback", Topic::Feedback, &def.action_feedback),
            listen("result", Topic::Result, &def.action_result),
            listen("status", Topic::Status, &states),
        ];
        *action.listening.lock() = listening;
        Ok(action)
    }

    /// Ready when the server takes goals and will be heard.
    async fn connected(&self) {
        // A server behind the same bridge is there already, and connects to nothing.
        if !self.is_local() {
            self.goal.connected().await;
        }
        let mut heard = self.heard.subscribe();
        // The sender lives as long as `self`.
        let _ = heard.wait_for(|heard| *heard).await;
    }

    fn is_local(&self) -> bool {
        self.client.upgrade().is_some_and(|client| client.shared.live_hub(&self.goal.topic).is_some())
    }

    fn feedback(&self, bytes: &Bytes) {
        let Some((state, body)) = actionlib::read_state(bytes) else { return };
        let Some(client) = self.client.upgrade() else { return };
        let mut goals = self.goals.lock();
        let Some(goal) = goals.get_mut(&state.goal.id) else { return };
        goal.seen = Instant::now();
        if !goal.feedback {
            return;
        }
        if client.outbox.control_waiting() >= FEEDBACK_WAITS {
            client.shared.metrics.dropped.add(1);
            client.shared.metrics.dropped_bytes.add(body.len() as u64);
            return;
        }
        let frame = goal.frame(&client, "action_feedback", &self.def.feedback, &body, |_| {});
        match frame {
            Ok(frame) => client.send_as(frame, goal.compression, goal.fragment_size),
            Err(reason) => client.error(&goal.reply(), &format!("action_feedback: {reason}")),
        }
    }

    fn result(&self, bytes: &Bytes) {
        let Some((state, body)) = actionlib::read_state(bytes) else { return };
        let Some(goal) = self.goals.lock().remove(&state.goal.id) else { return };
        let Some(client) = self.client.upgrade() else { return };
        let status = match state.status {
            Status::Succeeded => GoalStatus::Succeeded,
            Status::Preempted | Status::Recalled => GoalStatus::Canceled,
            Status::Aborted => GoalStatus::Aborted,
            Status::Rejected => {
                let reason = if state.text.is_empty() { "the goal was rejected" } else { &state.text };
                return goal.fail(&client, reason);
            }
            _ => GoalStatus::Unknown,
        };
        let frame = goal.frame(&client, "action_result", &self.def.result, &body, |writer| {
            writer.integer("status", status as i64);
            writer.boolean("result", true);
        });
        match frame {
            Ok(frame) => goal.answer(&client, frame),
            Err(reason) => goal.fail(&client, &format!("the result cannot be read: {reason}")),
        }
    }

    fn status(&self, bytes: &Bytes) {
        let Some(states) = actionlib::read_states(bytes) else { return };
        self.heard.send_replace(true);
        let now = Instant::now();
        let mut lost = Vec::new();
        let mut goals = self.goals.lock();
        for (id, goal) in goals.iter_mut() {
            if states.iter().any(|state| state.goal.id == *id) {
                goal.seen = now;
            } else if now.duration_since(goal.seen) > LOST_AFTER {
                lost.push(id.clone());
            }
        }
        let lost: Vec<_> = lost.iter().filter_map(|id| goals.remove(id)).collect();
        drop(goals);
        if let Some(client) = self.client.upgrade() {
            for goal in lost {
                goal.fail(&client, "the action server no longer knows the goal");
            }
        }
    }

    fn fail_all(&self, reason: &str) {
        let goals: Vec<_> = self.goals.lock().drain().map(|(_, goal)| goal).collect();
        if let Some(client) = self.client.upgrade() {
            for goal in goals {
                goal.fail(&client, reason);
            }
        }
    }
}

impl Drop for ActionClient {
    fn drop(&mut self) {
        // A robot that is gone needs its goals no longer.
        for id in self.goals.get_mut().keys() {
            self.cancel.publish(actionlib::write_cancel(&GoalId { stamp: Time::default(), id: id.clone() }));
        }
    }
}

impl Goal {
    fn reply(&self) -> Reply {
        Reply { id: self.id.clone(), format: print_format(self.compression) }
    }

    fn frame(
        &self,
        client: &Client,
        op: &str,
        message_type: &MessageType,
        body: &[u8],
        rest: impl FnOnce(&mut Writer<'_>),
    ) -> Result<Frame, String> {
        let format = print_format(self.compression);
        let mut out = Vec::with_capacity(256 + body.len());
        let mut writer = Writer::op(&mut out, format, op, self.id.as_ref());
        writer.text("action", &self.action);
        if self.compression == Compression::CborRaw {
            writer.text("compression", self.compression.name());
            writer.raw("values", None, body);
        } else {
            writer.value("values", |out| client.print_payload(message_type, body, format, out))?;
        }
        rest(&mut writer);
        writer.end();
        Ok(Frame { format, bytes: out.into() })
    }

    fn answer(self, client: &Client, frame: Frame) {
        if let Some(id) = &self.id {
            client.actions.lock().goals.remove(id);
        }
        self.done.notify_one();
        client.send_as(frame, self.compression, self.fragment_size);
    }

    fn fail(self, client: &Client, reason: &str) {
        let format = print_format(self.compression);
        let mut out = Vec::with_capacity(256);
        let mut writer = Writer::op(&mut out, format, "action_result", self.id.as_ref());
        writer.text("action", &self.action);
        writer.text("values", reason);
        writer.integer("status", GoalStatus::Unknown as i64);
        writer.boolean("result", false);
        writer.end();
        self.answer(client, Frame { format, bytes: out.into() });
    }
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
            _under_way: self.begin()?,
        };
        match self.prepare_goal(&op, compression) {
            Ok(prepared) => {
                if let Some(id) = &goal.id {
                    let known = (prepared.name.clone(), prepared.goal_id.clone());
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
        compression: Compression,
    ) -> Result<Prepared, String> {
        let name = resolve(&op.action)?.into_owned();
        let def = self.action_def(&name, &op.action_type)?;
        let body = decode_args(&def.goal, op.args, compression)?;
        let action = self.action_client(&name, def)?;
        let goal_id = format!("cloudroid-{}-{}", self.shared.next_number(), Time::now().secs);
        Ok(Prepared { action, name, goal_id, body })
    }

    fn action_client(self: &Arc<Self>, name: &str, def: Arc<ActionDef>) -> Result<Arc<ActionClient>, String> {
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

    pub(in crate::client) fn cancel_action_goal(&self, op: &CancelActionGoal<'_>) -> Result<(), String> {
        let id = op.id.clone().into_owned();
        let actions = self.actions.lock();
        let Some((name, goal_id)) = actions.goals.get(&id) else {
            return Err(format!("no goal with id {id} is under way"));
        };
        let Some(action) = actions.used.get(name).cloned() else { return Ok(()) };
        let goal = GoalId { stamp: Time::default(), id: goal_id.clone() };
        drop(actions);
        // A goal that still waits for its server is sent first, and cancelled behind that.
        action.cancel.publish(actionlib::write_cancel(&goal));
        Ok(())
    }
}

/// Sends a goal when its server is there, and sees to it that it is answered.
async fn run_goal(client: Weak<Client>, prepared: Prepared, goal: Goal) {
    let Prepared { action, name, goal_id, body } = prepared;
    let Some((patience, ended, graph)) = client.upgrade().map(|client| {
        let graph = client.shared.bus.graph();
        (client.shared.options.action_timeout, client.ended.clone(), graph)
    }) else {
        return;
    };
    let there = tokio::select! {
        () = ended.cancelled() => return,
        there = tokio::time::timeout(patience, action.connected()) => there,
    };
    if there.is_err() && !action.goal.has_subscriber() && !action.is_local() {
        if let Some(client) = client.upgrade() {
            goal.fail(&client, &format!("action server {name} did not connect within {patience:?}"));
        }
        return;
    }
    let done = goal.done.clone();
    let now = Time::now();
    let goal = Goal { seen: Instant::now(), ..goal };
    action.goals.lock().insert(goal_id.clone(), goal);
    action.goal.publish(actionlib::write_goal(now, &GoalId { stamp: now, id: goal_id.clone() }, &body));
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
async fn server_gone(mut graph: watch::Receiver<Arc<ros::bus::Graph>>, topic: String) {
    const PATIENCE: Duration = Duration::from_secs(3);
    let nobody = |graph: &Arc<ros::bus::Graph>| graph.topics.get(&topic).is_none_or(|nodes| nodes.publishers.is_empty());
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
