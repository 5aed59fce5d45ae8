//! Messages that are encoded before they are sent, one at a time.

use std::collections::BTreeSet;
use std::time::Duration;

use bytes::Bytes;

use super::outgoing_record::OutgoingRecord;
use crate::record::{ENCODED, FLAGS_AT, SERIALISE_AT};

/// Minimum size of a message worth encoding, in bytes.
const MIN_ENCODED_SIZE: usize = 1024;

/// The message that is being encoded, and the channels whose messages may be encoded.
#[derive(Debug, Default)]
pub(crate) struct Encoding {
    /// Channels whose messages are encoded while it `pays`.
    pub(crate) channels: BTreeSet<u32>,
    pub(crate) pays: bool,
    message: Option<(OutgoingRecord, EncodingStage)>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum EncodingStage {
    /// No encoder has taken it.
    Waiting,
    Taken,
    /// It is encoded, and may be sent.
    Done,
}

impl Encoding {
    /// Returns whether this message is to be encoded.
    pub(super) fn should_encode(&self, out: &OutgoingRecord) -> bool {
        let flags = out.head.get(FLAGS_AT);
        self.pays
            && out.payload.len() >= MIN_ENCODED_SIZE
            && flags.is_some_and(|flags| flags & ENCODED == 0)
            && out.channel.is_some_and(|channel| self.channels.contains(&channel))
    }

    pub(super) fn begin(&mut self, out: OutgoingRecord) {
        self.message = Some((out, EncodingStage::Waiting));
    }

    /// Takes the message to be encoded now: its channel, its payload, and whether it must be decodable on its own.
    pub(crate) fn take(&mut self) -> Option<(u32, Bytes, bool)> {
        let (out, stage) = self.message.as_mut().filter(|(_, stage)| *stage == EncodingStage::Waiting)?;
        *stage = EncodingStage::Taken;
        Some((out.channel?, out.payload.clone(), out.each))
    }

    /// Stores the encoded message; `None`: it is sent unencoded.
    pub(crate) fn finish(&mut self, frame: Option<(Bytes, Duration)>) {
        let Some((out, stage)) = &mut self.message else {
            return;
        };
        *stage = EncodingStage::Done;
        match frame {
            Some((frame, took)) => {
                out.head[FLAGS_AT] |= ENCODED;
                let took = u32::try_from(took.as_micros()).unwrap_or(u32::MAX);
                out.head[SERIALISE_AT..SERIALISE_AT + 4].copy_from_slice(&took.to_le_bytes());
                let plain = std::mem::replace(&mut out.payload, frame);
                out.plain = out.each.then_some(plain);
            }
            None => self.channels.retain(|channel| out.channel != Some(*channel)),
        }
    }

    /// Returns the message that is being encoded, or is encoded and not yet sent.
    pub(super) fn message(&self) -> Option<&OutgoingRecord> {
        self.message.as_ref().map(|(out, _)| out)
    }

    /// Returns the message once it is encoded.
    pub(super) fn encoded_message(&self) -> Option<&OutgoingRecord> {
        let encoded = self.message.as_ref().filter(|(_, stage)| *stage == EncodingStage::Done);
        encoded.map(|(out, _)| out)
    }

    /// Takes the message, whether it is encoded or not.
    pub(super) fn take_message(&mut self) -> Option<OutgoingRecord> {
        self.message.take().map(|(out, _)| out)
    }

    /// Forgets a channel and returns whether an encoded message was discarded.
    pub(super) fn forget(&mut self, channel: u32) -> bool {
        self.channels.remove(&channel);
        let is_encoded = self.encoded_message().is_some_and(|out| out.channel == Some(channel));
        is_encoded && self.take_message().is_some()
    }
}
