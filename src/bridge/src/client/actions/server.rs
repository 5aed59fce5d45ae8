//! A client as an action server.

use std::collections::HashMap;
use std::sync::{Arc, OnceLock, Weak};

use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{ActionHandler, GoalEnd, GoalOutcome};
use ros::codec;
use ros::schema::ActionDef;
use rosbridge::{AdvertiseAction, CancelActionGoal, Compression, Id, StatusLevel, Writer};

use crate::client::{BridgeClient, payload_format};
use crate::sample::EncodedFrame;

/// Reason for aborting goals.
const GONE: &str = "the client that serves this action is gone";

/// An action that a client serves.
pub(in crate::client) struct ActionServer {
    name: String,
    /// Name as the client wrote it.
    written: String,
    pub(super) def: Arc<ActionDef>,
    compression: Compression,
    /// Goals in progress: from the client's ids to the bus's.
    goals: Mutex<HashMap<String, String>>,
    /// Set once, right after construction: goals are sent to the server itself.
    bus: OnceLock<Box<dyn ros::bus::ActionServer>>,
    client: Weak<BridgeClient>,
}

/// Forwards goals to the client.
struct GoalHandler(Weak<ActionServer>);

impl ActionHandler for GoalHandler {
    fn on_goal(&self, id: &str, goal: Bytes) -> Result<(), String> {
        let server = self.0.upgrade().ok_or(GONE)?;
        server.send_goal(id, &goal)
    }

    fn on_cancel(&self, id: &str) {
        if let Some(server) = self.0.upgrade() {
            server.cancel(id);
        }
    }

    fn on_failed(&self, reason: &str) {
        if let Some(server) = self.0.upgrade()
            && let Some(client) = server.client.upgrade()
        {
            let text = format!("advertise_action: action {}: {reason}", server.name);
            client.send_status(
                StatusLevel::Error,
                None,
                payload_format(server.compression),
                &text,
            );
        }
    }
}

impl ActionServer {
    pub(super) fn open(
        client: &Arc<BridgeClient>,
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
        let handler = Arc::new(GoalHandler(Arc::downgrade(&server)));
        let served = client.shared.bus.serve_action(name, &server.def, handler);
        // Only set here.
        let _ = server.bus.set(served.map_err(|error| error.to_string())?);
        Ok(server)
    }

    fn send_goal(&self, id: &str, body: &Bytes) -> Result<(), String> {
        let client = self.client.upgrade().ok_or(GONE)?;
        let number = client.shared.next_number();
        let request = format!("action_goal:{}:{number}", self.name);
        let frame = self.frame(&client, &request, body)?;
        self.goals.lock().insert(request, id.to_owned());
        client.send_as(frame, self.compression, None);
        Ok(())
    }

    fn frame(
        &self,
        client: &BridgeClient,
        request: &str,
        body: &Bytes,
    ) -> Result<EncodedFrame, String> {
        let format = payload_format(self.compression);
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
        Ok(EncodedFrame::new(format, out))
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
            client.send(op.into(), payload_format(self.compression));
        }
    }

    fn no_such_goal(&self, request: &str) -> String {
        let action = &self.name;
        format!("action {action} has no goal with id {request:?} under way")
    }

    /// Publishes feedback on the goal that the client knows as `request`.
    pub(super) fn publish_feedback(&self, request: &str, body: Bytes) -> Result<(), String> {
        let id = self.goals.lock().get(request).cloned();
        let told = match (id, self.bus.get()) {
            (Some(id), Some(bus)) => bus.publish_feedback(&id, body),
            _ => false,
        };
        told.then_some(()).ok_or_else(|| self.no_such_goal(request))
    }

    /// Ends the goal that the client knows as `request`.
    pub(super) fn end_goal(
        &self,
        request: &str,
        outcome: GoalOutcome,
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
            (Some(id), Some(bus)) => bus.end_goal(&id, end),
            _ => false,
        };
        ended
            .then_some(())
            .ok_or_else(|| self.no_such_goal(request))
    }

    /// Returns a result with default values.
    pub(super) fn default_result(&self) -> Bytes {
        codec::default_message(&self.def.result).into()
    }
}

impl Drop for ActionServer {
    fn drop(&mut self) {
        let goals = std::mem::take(self.goals.get_mut());
        for id in goals.into_values() {
            if let Some(bus) = self.bus.get() {
                let end = GoalEnd {
                    outcome: GoalOutcome::Aborted,
                    text: GONE.to_owned(),
                    result: self.default_result(),
                };
                bus.end_goal(&id, end);
            }
        }
    }
}
