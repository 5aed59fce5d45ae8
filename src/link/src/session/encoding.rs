//! Encoding of outgoing messages on a slow link, and decoding of incoming ones.

use budget::{JsonWeight, Permit};
use codec::ReceiverFeedback;
use tokio::task::JoinHandle;

use super::{Session, State};
use crate::Error;
use crate::control::{self, ControlMessage, SessionMessage};
use crate::frame::Frame;
use crate::incoming::check_limit;
use crate::outgoing::DeliveryMode;
use crate::packing::EncodedMessage;
use crate::record::Data;

impl<O: ControlMessage> Session<O> {
    /// Starts encoding the next message on another thread.
    pub(super) fn start_encoding(&self) -> Option<JoinHandle<EncodedMessage>> {
        let mut state = self.state.lock();
        let State { out, packing, throughput, .. } = &mut *state;
        let (channel, message, alone) = out.encoding.take()?;
        let Some(job) = packing.encode_job(channel, message, alone, throughput.estimate()) else {
            out.encoding.finish(None);
            self.wake.notify_one();
            return None;
        };
        Some(tokio::task::spawn_blocking(job))
    }

    pub(super) fn finish_encoding(&self, packed: Option<EncodedMessage>) {
        let state = &mut *self.state.lock();
        state.out.encoding.finish(packed.map(|packed| state.packing.finish(packed)));
    }

    /// Decodes a message. If that fails, returns the frame to send to the peer immediately, if any.
    pub(super) fn decode_message(&self, data: Data) -> Result<Data, Option<Frame>> {
        if !data.encoded {
            return Ok(data);
        }
        let channel = data.channel;
        let (message, answer) = self.state.lock().packing.decode(channel, &data.message);
        let error = match message {
            Ok(message) => return Ok(Data { message, encoded: false, ..data }),
            Err(error) => error,
        };
        if answer == Some(ReceiverFeedback::Damaged) {
            tracing::warn!(channel, %error, "a message arrived damaged");
            return Err(Some(Frame::Damaged { channel, born: data.born }));
        }
        tracing::debug!(channel, %error, "a message cannot be decoded");
        if answer == Some(ReceiverFeedback::Keyframe) {
            self.control_record(&SessionMessage::Keyframe { channel })
                .inspect(|ask| self.push(ask, DeliveryMode::Each));
        }
        Err(None)
    }

    /// Handles a message that arrived damaged at the peer: its topic is no longer encoded with that codec.
    pub(super) fn on_damaged(&self, channel: u32, born: i64) {
        let mut state = self.state.lock();
        state.packing.on_answer(channel, ReceiverFeedback::Damaged);
        let again = state.out.resend_damaged(channel, born);
        let topic = state.topics.get(&channel).cloned().unwrap_or_default();
        drop(state);
        let then = if again { "; it is sent again" } else { "" };
        tracing::warn!(topic, "a message arrived damaged at the other end{then}");
    }

    /// Parses a control record. Returns `None` for a message between the sessions, which is handled here. The record is
    /// charged to `held` before it is parsed.
    pub(super) fn parse_control(&self, json: &[u8], held: &mut Permit) -> Result<Option<O::FromPeer>, Error> {
        check_limit("a control record", json.len(), control::max_control_length(json))?;
        held.resize(JsonWeight::estimate(json).bytes)?;
        // The name comes first in the JSON, so a message of the other type is recognized immediately.
        if let Ok(SessionMessage::Keyframe { channel }) = serde_json::from_slice(json) {
            self.state.lock().packing.on_answer(channel, ReceiverFeedback::Keyframe);
            return Ok(None);
        }
        let order = serde_json::from_slice(json);
        Ok(order.inspect_err(|error| tracing::debug!(%error, "the other end sent something unknown")).ok())
    }
}
