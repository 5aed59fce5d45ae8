//! A client as an action client: the goals it has sent.

use std::sync::{Arc, OnceLock, Weak};
use std::time::{Duration, Instant};

use bytes::Bytes;
use ros::bus::{GoalEnd, GoalError, GoalEvents, GoalOutcome};
use ros::codec::{self, CodecError};
use ros::schema::{ActionDef, MessageType};
use rosbridge::{Compression, GoalStatus, Id, Writer};

use crate::client::{BridgeClient, InFlightGuard, ReplyTarget, payload_format};
use crate::sample::EncodedFrame;

/// Number of queued answers above which feedback is dropped.
const FEEDBACK_WAITS: usize = 256;

/// A goal of a client.
pub(super) struct SentGoal {
    pub(super) client: Weak<BridgeClient>,
    /// Name of the action as the client wrote it.
    pub(super) action: String,
    pub(super) id: Option<Id<'static>>,
    /// Id used by the server; empty for refused goals.
    pub(super) goal_id: String,
    pub(super) feedback: bool,
    pub(super) compression: Compression,
    pub(super) fragment_size: Option<usize>,
    /// The definition and the guard that counts the goal as in progress; `None` for refused goals.
    pub(super) begun: Option<(Arc<ActionDef>, InFlightGuard)>,
    /// Time at which it was sent to the servant.
    pub(super) sent: OnceLock<Instant>,
}

impl GoalEvents for SentGoal {
    fn on_feedback(&self, body: Bytes) {
        let (Some(client), Some((def, _))) = (self.client.upgrade(), &self.begun) else {
            return;
        };
        if !self.feedback {
            return;
        }
        if client.outbox.control_len() >= FEEDBACK_WAITS {
            client.shared.metrics.dropped.add(1);
            client.shared.metrics.dropped_bytes.add(body.len() as u64);
            return;
        }
        match self.frame(&client, "action_feedback", &def.feedback, &body, |_| {}) {
            Ok(frame) => client.send_as(frame, self.compression, self.fragment_size),
            Err(error) => client.error(&self.reply(), &format!("action_feedback: {error}")),
        }
    }

    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        self.record_duration(&end);
        let (status, end) = match end {
            Err(error) => return self.fail(&error.to_string()),
            Ok(end) => match end.outcome {
                GoalOutcome::Succeeded => (GoalStatus::Succeeded, end),
                GoalOutcome::Canceled => (GoalStatus::Canceled, end),
                GoalOutcome::Aborted => (GoalStatus::Aborted, end),
                GoalOutcome::Unknown => (GoalStatus::Unknown, end),
                GoalOutcome::Rejected if end.text.is_empty() => {
                    return self.fail("the goal was rejected");
                }
                GoalOutcome::Rejected => return self.fail(&end.text),
            },
        };
        self.succeed(status, &end.text, &end.result);
    }
}

impl SentGoal {
    /// Records the duration; nothing if the client has cancelled the goal, which says nothing about the server.
    fn record_duration(&self, end: &Result<GoalEnd, GoalError>) {
        let outcome = end.as_ref().ok().map(|end| end.outcome);
        let (Some(client), Some(sent)) = (self.client.upgrade(), self.sent.get()) else {
            return;
        };
        let took: Option<Duration> = match outcome {
            Some(GoalOutcome::Canceled) => return,
            Some(GoalOutcome::Succeeded) => Some(sent.elapsed()),
            _ => None,
        };
        client.shared.options.called.record(took);
    }

    fn reply(&self) -> ReplyTarget {
        ReplyTarget { id: self.id.clone(), format: payload_format(self.compression) }
    }

    fn frame(
        &self,
        client: &BridgeClient,
        op: &str,
        message_type: &MessageType,
        body: &[u8],
        rest: impl FnOnce(&mut Writer<'_>),
    ) -> Result<EncodedFrame, Box<CodecError>> {
        let format = payload_format(self.compression);
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
        Ok(EncodedFrame::new(format, out))
    }

    /// Answers with a result.
    fn succeed(&self, status: GoalStatus, text: &str, result: &[u8]) {
        let (Some(client), Some((def, _))) = (self.client.upgrade(), &self.begun) else {
            return;
        };
        let frame = self.frame(&client, "action_result", &def.result, result, |writer| {
            writer.integer("status", status as i64);
            if !text.is_empty() {
                writer.text("text", text);
            }
            writer.boolean("result", true);
        });
        match frame {
            Ok(frame) => self.answer(&client, frame),
            Err(error) => self.fail(&format!("the result cannot be read: {error}")),
        }
    }

    fn answer(&self, client: &BridgeClient, frame: EncodedFrame) {
        client.actions.lock().goals.remove(&self.goal_id);
        client.send_as(frame, self.compression, self.fragment_size);
    }

    /// Answers that the goal was cancelled before it was sent to its server.
    pub(super) fn answer_recalled(&self) {
        if let Some((def, _)) = &self.begun {
            let nothing = codec::default_message(&def.result);
            self.succeed(GoalStatus::Canceled, "", &nothing);
        }
    }

    pub(super) fn fail(&self, reason: &str) {
        let Some(client) = self.client.upgrade() else {
            return;
        };
        let format = payload_format(self.compression);
        let mut out = Vec::with_capacity(256);
        let mut writer = Writer::op(&mut out, format, "action_result", self.id.as_ref());
        writer.text("action", &self.action);
        writer.text("values", reason);
        writer.integer("status", GoalStatus::Unknown as i64);
        writer.boolean("result", false);
        writer.end();
        self.answer(&client, EncodedFrame::new(format, out));
    }
}
