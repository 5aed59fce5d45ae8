//! A client as an action server.

use std::sync::{Arc, OnceLock, Weak};

use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{ActionHandler, BusError, FailureReason, GoalEnd, GoalOutcome};
use ros::codec::{self, CodecError};
use ros::schema::ActionDef;
use rosbridge::{AdvertiseAction, CancelActionGoal, Compression, Id, StatusLevel, Writer};

use super::ClientActionError;
use crate::client::{BridgeClient, payload_format};
use crate::client_state::ActionServer;
use crate::sample::EncodedFrame;

/// Reason for aborting goals.
const CLIENT_GONE: &str = "the client that serves this action is gone";

/// Forwards goals to the client.
struct GoalHandler(Weak<ActionServer>);

impl ActionHandler for GoalHandler {
    fn on_goal(&self, id: &str, goal: Bytes) -> Result<(), FailureReason> {
        let gone = || FailureReason::new(CLIENT_GONE);
        let server = self.0.upgrade().ok_or_else(gone)?;
        let client = server.client.upgrade().ok_or_else(gone)?;
        let sent = server.send_goal(&client, id, &goal);
        sent.map_err(|error| FailureReason::new(error.to_string()))
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
            client.send_status(StatusLevel::Error, None, payload_format(server.compression), &text);
        }
    }
}

impl ActionServer {
    pub(super) fn open(
        client: &Arc<BridgeClient>,
        name: &str,
        op: &AdvertiseAction<'_>,
        def: Arc<ActionDef>,
    ) -> Result<Arc<Self>, BusError> {
        let server = Arc::new(Self {
            name: name.to_owned(),
            written: op.action.clone().into_owned(),
            written_type: op.type_name.clone().into_owned(),
            def,
            compression: op.compression,
            goals: Mutex::default(),
            bus: OnceLock::new(),
            client: Arc::downgrade(client),
        });
        let handler = Arc::new(GoalHandler(Arc::downgrade(&server)));
        let served = client.shared.bus.serve_action(name, &server.def, handler);
        // Only set here.
        let _ = server.bus.set(served?);
        Ok(server)
    }

    fn send_goal(&self, client: &BridgeClient, id: &str, body: &Bytes) -> Result<(), Box<CodecError>> {
        let number = client.shared.next_number();
        let request = format!("action_goal:{}:{number}", self.name);
        let frame = self.frame(client, &request, body)?;
        self.goals.lock().insert(request, id.to_owned());
        client.send_as(frame, self.compression, None);
        Ok(())
    }

    fn frame(&self, client: &BridgeClient, request: &str, body: &Bytes) -> Result<EncodedFrame, Box<CodecError>> {
        let format = payload_format(self.compression);
        let mut out = Vec::with_capacity(256 + body.len());
        let mut writer = Writer::op(&mut out, format, "send_action_goal", Some(&Id::from(request)));
        writer.text("action", &self.written);
        writer.text("action_type", &self.written_type);
        if self.compression == Compression::CborRaw {
            writer.text("compression", self.compression.name());
            writer.raw("args", None, body);
        } else {
            writer.value("args", |out| client.print_payload(&self.def.goal, body, format, out))?;
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
            let op = CancelActionGoal { id: request.into(), action: (&*self.written).into() };
            client.send(op.into(), payload_format(self.compression));
        }
    }

    fn no_such_goal(&self, request: &str) -> ClientActionError {
        ClientActionError::NoServedGoal { action: self.name.clone(), request: request.to_owned() }
    }

    /// Publishes feedback on the goal that the client knows as `request`.
    pub(super) fn publish_feedback(&self, request: &str, body: Bytes) -> Result<(), ClientActionError> {
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
    ) -> Result<(), ClientActionError> {
        let id = self.goals.lock().remove(request);
        let end = GoalEnd { outcome, text: text.to_owned(), result };
        let ended = match (id, self.bus.get()) {
            (Some(id), Some(bus)) => bus.end_goal(&id, end),
            _ => false,
        };
        ended.then_some(()).ok_or_else(|| self.no_such_goal(request))
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
                    text: CLIENT_GONE.to_owned(),
                    result: self.default_result(),
                };
                bus.end_goal(&id, end);
            }
        }
    }
}
