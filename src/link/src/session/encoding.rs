//! What a slow link carries is made smaller on its way out, and as it was on its way in.

use budget::{JsonWeight, Permit};
use codec::Answer;
use tokio::task::JoinHandle;

use super::{Session, State};
use crate::Error;
use crate::control::{self, Between, Control, Order};
use crate::frame::Frame;
use crate::incoming::too_much;
use crate::packing::Packed;
use crate::record::Data;

impl<O: Order> Session<O> {
    /// Begins to encode the next message that is to be, on another thread.
    pub(super) fn pack(&self) -> Option<JoinHandle<Packed>> {
        let mut state = self.state.lock();
        let State {
            out,
            packing,
            throughput,
            ..
        } = &mut *state;
        let (channel, message, alone) = out.encoding.take()?;
        let Some(job) = packing.job(channel, message, alone, throughput.known()) else {
            out.encoding.finish(None);
            self.wake.notify_one();
            return None;
        };
        Some(tokio::task::spawn_blocking(move || job.run()))
    }

    pub(super) fn packed(&self, packed: Option<Packed>) {
        let state = &mut *self.state.lock();
        let frame = packed.map(|packed| {
            let took = packed.took;
            (state.packing.done(packed), took)
        });
        state.out.encoding.finish(frame);
    }

    /// A message as it was before it was encoded; where that cannot be told, what the peer is to be told at once.
    pub(super) fn unpacked(&self, mut data: Data) -> Result<Data, Option<Frame>> {
        if !data.encoded {
            return Ok(data);
        }
        let channel = data.channel;
        let (message, answer) = self.state.lock().packing.unpack(channel, &data.message);
        let error = match message {
            Ok(message) => {
                data.message = message;
                data.encoded = false;
                return Ok(data);
            }
            Err(error) => error,
        };
        match answer {
            Some(Answer::Keyframe) => {
                tracing::debug!(channel, %error, "a message cannot be decoded");
                self.ask_for_keyframe(channel);
                Err(None)
            }
            Some(Answer::Damaged) => {
                tracing::warn!(channel, %error, "a message came damaged");
                let born = data.born;
                Err(Some(Frame::Damaged { channel, born }))
            }
            None => {
                tracing::debug!(channel, %error, "a message cannot be decoded");
                Err(None)
            }
        }
    }

    /// A message came to the peer otherwise than it was: its topic does without that codec from now on.
    pub(super) fn came_damaged(&self, channel: u32, born: i64) {
        let mut state = self.state.lock();
        state.packing.answered(channel, Answer::Damaged);
        let again = state.out.again(channel, born);
        let topic = state.topics.get(&channel).cloned().unwrap_or_default();
        drop(state);
        let then = if again { "; it is sent again" } else { "" };
        tracing::warn!(topic, "a message came damaged at the other end{then}");
    }

    /// What the peer orders, unless its session tells this one something. The order counts in `held`, from before it is read.
    pub(super) fn understood(
        &self,
        json: &[u8],
        held: &mut Permit,
    ) -> Result<Option<O::OfPeer>, Error> {
        let limit = control::longest(json);
        if json.len() > limit {
            return Err(too_much("a control record", json.len(), limit));
        }
        held.resize(JsonWeight::of(json).bytes)?;
        match Control::read(json) {
            Ok(Control::Order(order)) => return Ok(Some(order)),
            Ok(Control::Between(Between::Keyframe { channel })) => {
                let packing = &mut self.state.lock().packing;
                packing.answered(channel, Answer::Keyframe);
            }
            Err(error) => tracing::debug!(%error, "the other end tells something unknown"),
        }
        Ok(None)
    }
}
