//! A client as an action client: the goals it has sent, followed over actionlib's topics.

use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use bytes::Bytes;
use parking_lot::Mutex;
use ros::codec::Time;
use ros::schema::{ActionDef, MessageType};
use rosbridge::{Compression, GoalStatus, Id, Writer};
use tokio::sync::{Notify, watch};
use tokio::time::timeout;

use super::{common_type, is_type};
use crate::actionlib::{self, GoalId, Status};
use crate::client::{Client, Reply, UnderWay, print_format};
use crate::hub::{Listener, Listening};
use crate::outlet::Outlet;
use crate::sample::{Frame, Sample};

/// A goal that the server has stopped speaking of is lost.
const LOST_AFTER: Duration = Duration::from_secs(5);
/// How long a cancel waits for a server that has taken the goal and is not connected for cancels yet.
const CANCEL_WAITS: Duration = Duration::from_secs(10);
/// Feedback is left out while so many answers wait.
const FEEDBACK_WAITS: usize = 256;

/// One action that a client sends goals to.
pub(super) struct ActionClient {
    pub(super) def: Arc<ActionDef>,
    pub(super) goal: Arc<Outlet>,
    pub(super) cancel: Arc<Outlet>,
    pub(super) goals: Mutex<HashMap<String, Goal>>,
    /// Whether the server's status has been heard: it is connected then.
    heard: watch::Sender<bool>,
    /// Set once, right after it was made: the listeners need the client itself.
    listening: Mutex<Vec<Listening>>,
    client: Weak<Client>,
}

pub(super) struct Goal {
    /// As the client wrote it.
    pub(super) action: String,
    pub(super) id: Option<Id<'static>>,
    pub(super) feedback: bool,
    pub(super) compression: Compression,
    pub(super) fragment_size: Option<usize>,
    /// When the server last spoke of it.
    pub(super) seen: Instant,
    pub(super) done: Arc<Notify>,
    pub(super) _under_way: Option<UnderWay>,
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
        let Some(action) = self.action.upgrade() else {
            return;
        };
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
    pub(super) fn open(
        client: &Arc<Client>,
        name: &str,
        def: Arc<ActionDef>,
    ) -> Result<Arc<Self>, String> {
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
            let listener = TopicListener {
                action: Arc::downgrade(&action),
                topic,
                expected: expected.clone(),
            };
            shared
                .hub(&format!("{name}/{part}"), Some(expected))
                .listen(Arc::new(listener))
        };
        let listening = vec![
            listen("feedback", Topic::Feedback, &def.action_feedback),
            listen("result", Topic::Result, &def.action_result),
            listen("status", Topic::Status, &states),
        ];
        *action.listening.lock() = listening;
        Ok(action)
    }

    /// Cancels a goal that was sent; its server hears of it as soon as it is connected.
    pub(super) fn cancel(self: &Arc<Self>, id: &str) {
        let cancel = actionlib::write_cancel(&GoalId {
            stamp: Time::default(),
            id: id.to_owned(),
        });
        if self.is_local() || self.cancel.has_subscriber() {
            return self.cancel.publish(cancel);
        }
        let (action, id) = (self.clone(), id.to_owned());
        tokio::spawn(async move {
            // Not for ever: a server need not care for cancels.
            let _ = timeout(CANCEL_WAITS, action.cancel.connected()).await;
            if action.goals.lock().contains_key(&id) {
                action.cancel.publish(cancel);
            }
        });
    }

    /// Ready when the server takes goals and will be heard.
    pub(super) async fn connected(&self) {
        // A server behind the same bridge is there already, and connects to nothing.
        if !self.is_local() {
            self.goal.connected().await;
        }
        let mut heard = self.heard.subscribe();
        // The sender lives as long as `self`.
        let _ = heard.wait_for(|heard| *heard).await;
    }

    pub(super) fn is_local(&self) -> bool {
        self.client
            .upgrade()
            .is_some_and(|client| client.shared.live_hub(&self.goal.topic).is_some())
    }

    fn feedback(&self, bytes: &Bytes) {
        let Some((state, body)) = actionlib::read_state(bytes) else {
            return;
        };
        let Some(client) = self.client.upgrade() else {
            return;
        };
        let mut goals = self.goals.lock();
        let Some(goal) = goals.get_mut(&state.goal.id) else {
            return;
        };
        goal.seen = Instant::now();
        if !goal.feedback {
            return;
        }
        if client.outbox.control_waiting() >= FEEDBACK_WAITS {
            client.shared.metrics.dropped.add(1);
            client.shared.metrics.dropped_bytes.add(body.len() as u64);
            return;
        }
        let frame = goal.frame(
            &client,
            "action_feedback",
            &self.def.feedback,
            &body,
            |_| {},
        );
        match frame {
            Ok(frame) => client.send_as(frame, goal.compression, goal.fragment_size),
            Err(reason) => client.error(&goal.reply(), &format!("action_feedback: {reason}")),
        }
    }

    fn result(&self, bytes: &Bytes) {
        let Some((state, body)) = actionlib::read_state(bytes) else {
            return;
        };
        let Some(goal) = self.goals.lock().remove(&state.goal.id) else {
            return;
        };
        let Some(client) = self.client.upgrade() else {
            return;
        };
        let status = match state.status {
            Status::Succeeded => GoalStatus::Succeeded,
            Status::Preempted | Status::Recalled => GoalStatus::Canceled,
            Status::Aborted => GoalStatus::Aborted,
            Status::Rejected => {
                let reason = if state.text.is_empty() {
                    "the goal was rejected"
                } else {
                    &state.text
                };
                return goal.fail(&client, reason);
            }
            _ => GoalStatus::Unknown,
        };
        let frame = goal.frame(
            &client,
            "action_result",
            &self.def.result,
            &body,
            |writer| {
                writer.integer("status", status as i64);
                if !state.text.is_empty() {
                    writer.text("text", &state.text);
                }
                writer.boolean("result", true);
            },
        );
        match frame {
            Ok(frame) => goal.answer(&client, frame),
            Err(reason) => goal.fail(&client, &format!("the result cannot be read: {reason}")),
        }
    }

    fn status(&self, bytes: &Bytes) {
        let Some(states) = actionlib::read_states(bytes) else {
            return;
        };
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
            self.cancel.publish(actionlib::write_cancel(&GoalId {
                stamp: Time::default(),
                id: id.clone(),
            }));
        }
    }
}

impl Goal {
    fn reply(&self) -> Reply {
        Reply {
            id: self.id.clone(),
            format: print_format(self.compression),
        }
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
            writer.value("values", |out| {
                client.print_payload(message_type, body, format, out)
            })?;
        }
        rest(&mut writer);
        writer.end();
        Ok(Frame::new(format, out))
    }

    fn answer(self, client: &Client, frame: Frame) {
        if let Some(id) = &self.id {
            client.actions.lock().goals.remove(id);
        }
        self.done.notify_one();
        client.send_as(frame, self.compression, self.fragment_size);
    }

    /// Answers that it was cancelled before its server has heard of it.
    pub(super) fn recalled(self, client: &Client, def: &ActionDef) {
        let body = vec![0; def.result.min_size()];
        let frame = self.frame(client, "action_result", &def.result, &body, |writer| {
            writer.integer("status", GoalStatus::Canceled as i64);
            writer.boolean("result", true);
        });
        match frame {
            Ok(frame) => self.answer(client, frame),
            Err(reason) => self.fail(client, &reason),
        }
    }

    pub(super) fn fail(self, client: &Client, reason: &str) {
        let format = print_format(self.compression);
        let mut out = Vec::with_capacity(256);
        let mut writer = Writer::op(&mut out, format, "action_result", self.id.as_ref());
        writer.text("action", &self.action);
        writer.text("values", reason);
        writer.integer("status", GoalStatus::Unknown as i64);
        writer.boolean("result", false);
        writer.end();
        self.answer(client, Frame::new(format, out));
    }
}
