//! What a slow link carries is made smaller on its way out, and as it was on its way in.

use codec::Answer;
use tokio::task::JoinHandle;

use super::{Session, State};
use crate::control::Control;
use crate::packing::Packed;
use crate::record::Data;

impl Session {
    /// Begins to encode the next message that is to be, on another thread.
    pub(super) fn pack(&self) -> Option<JoinHandle<Packed>> {
        let mut state = self.state.lock();
        let State {
            out,
            packing,
            throughput,
            ..
        } = &mut *state;
        let (channel, message, alone) = out.take_to_pack()?;
        let Some(job) = packing.job(channel, message, alone, throughput.known()) else {
            out.packed(None);
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
        state.out.packed(frame);
    }

    /// A message as it was before it was encoded; none where that cannot be told.
    pub(super) fn unpacked(&self, mut data: Data) -> Option<Data> {
        if !data.encoded {
            return Some(data);
        }
        let channel = data.channel;
        let (message, answer) = self.state.lock().packing.unpack(channel, &data.message);
        match answer {
            Some(Answer::Acknowledge(sequence)) => {
                self.tell(&Control::Decoded { channel, sequence })
            }
            Some(Answer::Keyframe) => self.tell(&Control::Keyframe { channel }),
            None => {}
        }
        match message {
            Ok(message) => {
                data.message = message;
                data.encoded = false;
                Some(data)
            }
            Err(error) => {
                tracing::debug!(channel, %error, "a message cannot be decoded");
                None
            }
        }
    }

    /// What the peer says of frames that it was sent; others are the handler's.
    pub(super) fn is_answer(&self, json: &[u8]) -> bool {
        if !json.starts_with(b"{\"decoded\"") && !json.starts_with(b"{\"keyframe\"") {
            return false;
        }
        let (channel, answer) = match serde_json::from_slice(json) {
            Ok(Control::Decoded { channel, sequence }) => (channel, Answer::Acknowledge(sequence)),
            Ok(Control::Keyframe { channel }) => (channel, Answer::Keyframe),
            _ => return false,
        };
        self.state.lock().packing.answered(channel, answer);
        true
    }
}
