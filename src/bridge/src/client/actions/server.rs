//! A client as an action server.

use std::collections::HashMap;
use std::sync::{Arc, OnceLock, Weak};

use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{ActionHandler, GoalEnd, Outcome};
use ros::codec;
use ros::schema::ActionDef;
use rosbridge::{AdvertiseAction, CancelActionGoal, Compression, Id, Level, Writer};

use crate::client::{Client, print_format};
use crate::sample::Frame;

/// Why goals are given up.
const GONE: &str = "the client that serves this action is gone";

/// One action that a client serves.
pub(in crate::client) struct ActionServer {
    name: String,
    /// As the client wrote it.
    written: String,
    pub(super) def: Arc<ActionDef>,
    compression: Compression,
    /// Goals under way, by what the client calls them: what the bus calls them.
    goals: Mutex<HashMap<String, String>>,
    /// Set once, right after it was made: goals come to the server itself.
    bus: OnceLock<Box<dyn ros::bus::ActionServer>>,
    client: Weak<Client>,
}

/// Passes goals to the client.
struct Handler(Weak<ActionServer>);

impl ActionHandler for Handler {
    fn goal(&self, id: &str, goal: Bytes) -> Result<(), String> {
        let server = self.0.upgrade().ok_or(GONE)?;
        server.goal(id, &goal)
    }

    fn cancel(&self, id: &str) {
        if let Some(server) = self.0.upgrade() {
            server.cancel(id);
        }
    }

    fn failed(&self, reason: &str) {
        if let Some(server) = self.0.upgrade()
            && let Some(client) = server.client.upgrade()
        {
            let text = format!("advertise_action: action {}: {reason}", server.name);
            client.status(Level::Error, None, print_format(server.compression), &text);
        }
    }
}

impl ActionServer {
    pub(super) fn open(
        client: &Arc<Client>,
        name: &str,
        op: &AdvertiseAction<'_>,
        def: Arc<ActionDef>,
    ) -> Result<Arc<Self>, String> {
        let server = Arc::new(Self {
            name: name.to_owned(),
            written: op.action.clone().into_owned(),
            def,
            compression: op.compression,
            goals: Mutex::default(),
            bus: OnceLock::new(),
            client: Arc::downgrade(client),
        });
        let handler = Arc::new(Handler(Arc::downgrade(&server)));
        let served = client.shared.bus.serve_action(name, &server.def, handler);
        // Set once, here.
        let _ = server.bus.set(served.map_err(|error| error.to_string())?);
        Ok(server)
    }

    fn goal(&self, id: &str, body: &Bytes) -> Result<(), String> {
        let client = self.client.upgrade().ok_or(GONE)?;
        let number = client.shared.next_number();
        let request = format!("action_goal:{}:{number}", self.name);
        let frame = self.frame(&client, &request, body)?;
        self.goals.lock().insert(request, id.to_owned());
        client.send_as(frame, self.compression, None);
        Ok(())
    }

    fn frame(&self, client: &Client, request: &str, body: &Bytes) -> Result<Frame, String> {
        let format = print_format(self.compression);
        let mut out = Vec::with_capacity(256 + body.len());
        let mut writer = Writer::op(
            &mut out,
            format,
            "send_action_goal",
            Some(&Id::from(request)),
        );
        writer.text("action", &self.written);
        writer.text("action_type", &self.def.name);
        if self.compression == Compression::CborRaw {
            writer.text("compression", self.compression.name());
            writer.raw("args", None, body);
        } else {
            writer.value("args", |out| {
                client.print_payload(&self.def.goal, body, format, out)
            })?;
        }
        writer.boolean("feedback", true);
        writer.end();
        Ok(Frame::new(format, out))
    }

    fn cancel(&self, id: &str) {
        let request = {
            let goals = self.goals.lock();
            let known = goals.iter().find(|(_, goal)| *goal == id);
            known.map(|(request, _)| request.clone())
        };
        if let (Some(request), Some(client)) = (request, self.client.upgrade()) {
            let op = CancelActionGoal {
                id: request.into(),
                action: (&*self.written).into(),
            };
            client.send(op.into(), print_format(self.compression));
        }
    }

    fn no_such_goal(&self, request: &str) -> String {
        let action = &self.name;
        format!("action {action} has no goal with id {request:?} under way")
    }

    /// Passes on how the goal that the client calls `request` gets on.
    pub(super) fn publish_feedback(&self, request: &str, body: Bytes) -> Result<(), String> {
        let id = self.goals.lock().get(request).cloned();
        let told = match (id, self.bus.get()) {
            (Some(id), Some(bus)) => bus.feedback(&id, body),
            _ => false,
        };
        told.then_some(()).ok_or_else(|| self.no_such_goal(request))
    }

    /// Ends the goal that the client calls `request`.
    pub(super) fn end_goal(
        &self,
        request: &str,
        outcome: Outcome,
        text: &str,
        result: Bytes,
    ) -> Result<(), String> {
        let id = self.goals.lock().remove(request);
        let end = GoalEnd {
            outcome,
            text: text.to_owned(),
            result,
        };
        let ended = match (id, self.bus.get()) {
            (Some(id), Some(bus)) => bus.end(&id, end),
            _ => false,
        };
        ended
            .then_some(())
            .ok_or_else(|| self.no_such_goal(request))
    }

    /// A result of defaults.
    pub(super) fn nothing(&self) -> Bytes {
        codec::default_message(&self.def.result).into()
    }
}

impl Drop for ActionServer {
    fn drop(&mut self) {
        let goals = std::mem::take(self.goals.get_mut());
        for id in goals.into_values() {
            if let Some(bus) = self.bus.get() {
                let end = GoalEnd {
                    outcome: Outcome::Aborted,
                    text: GONE.to_owned(),
                    result: self.nothing(),
                };
                bus.end(&id, end);
            }
        }
    }
}
