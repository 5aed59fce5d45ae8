//! Messages that are encoded before they are sent, one at a time.

use std::collections::BTreeSet;
use std::time::Duration;

use bytes::Bytes;

use super::out::OutgoingRecord;
use crate::record::{ENCODED, FLAGS_AT, SERIALISE_AT};

/// Minimum size of a message worth encoding, in bytes.
const WORTH_IT: usize = 1024;

/// The message that is being encoded, and the channels whose messages may be encoded.
#[derive(Debug, Default)]
pub(crate) struct Encoding {
    /// Channels whose messages are encoded while it `pays`.
    channels: BTreeSet<u32>,
    pays: bool,
    /// The message, and whether an encoder has taken it.
    message: Option<(OutgoingRecord, bool)>,
    done: Option<OutgoingRecord>,
}

impl Encoding {
    /// Allows messages of this channel to be encoded.
    pub(crate) fn add(&mut self, channel: u32) {
        self.channels.insert(channel);
    }

    /// No longer encodes messages of this channel.
    pub(super) fn remove(&mut self, channel: u32) {
        self.channels.remove(&channel);
    }

    #[cfg(test)]
    pub(super) fn channels(&self) -> &BTreeSet<u32> {
        &self.channels
    }

    /// Sets whether encoding is worthwhile.
    pub(crate) fn set_enabled(&mut self, pays: bool) {
        self.pays = pays;
    }

    /// Returns whether this message is to be encoded.
    pub(super) fn should_encode(&self, out: &OutgoingRecord) -> bool {
        let flags = out.head.get(FLAGS_AT);
        self.pays
            && out.payload.len() >= WORTH_IT
            && flags.is_some_and(|flags| flags & ENCODED == 0)
            && out.channel.is_some_and(|channel| self.channels.contains(&channel))
    }

    pub(super) fn begin(&mut self, out: OutgoingRecord) {
        self.message = Some((out, false));
    }

    /// Takes the message to be encoded now: its channel, its payload, and whether it must be decodable on its own.
    pub(crate) fn take(&mut self) -> Option<(u32, Bytes, bool)> {
        let (out, taken) = self.message.as_mut().filter(|(_, taken)| !taken)?;
        *taken = true;
        Some((out.channel?, out.payload.clone(), out.each))
    }

    /// Stores the encoded message; `None`: it is sent unencoded.
    pub(crate) fn finish(&mut self, frame: Option<(Bytes, Duration)>) {
        let Some((mut out, _)) = self.message.take() else {
            return;
        };
        match frame {
            Some((frame, took)) => {
                out.head[FLAGS_AT] |= ENCODED;
                let took = u32::try_from(took.as_micros()).unwrap_or(u32::MAX);
                out.head[SERIALISE_AT..SERIALISE_AT + 4].copy_from_slice(&took.to_le_bytes());
                let plain = std::mem::replace(&mut out.payload, frame);
                out.plain = out.each.then_some(plain);
            }
            None => {
                if let Some(channel) = out.channel {
                    self.channels.remove(&channel);
                }
            }
        }
        self.done = Some(out);
    }

    /// Takes the encoded message, if it `may` be sent.
    pub(super) fn take_encoded(&mut self, may: impl FnOnce(&mut OutgoingRecord) -> bool) -> Option<OutgoingRecord> {
        self.done.take_if(may)
    }

    pub(super) fn has_encoded(&self) -> bool {
        self.done.is_some()
    }

    pub(super) fn is_busy(&self) -> bool {
        self.message.is_some()
    }

    pub(super) fn is_empty(&self) -> bool {
        !self.has_encoded() && !self.is_busy()
    }

    /// Returns the message being encoded and the encoded one.
    pub(super) fn messages(&self) -> impl Iterator<Item = &OutgoingRecord> {
        self.message.iter().map(|(out, _)| out).chain(&self.done)
    }

    /// Removes both messages and returns them.
    pub(super) fn drain(&mut self) -> impl Iterator<Item = OutgoingRecord> + use<> {
        let message = self.message.take().map(|(out, _)| out);
        message.into_iter().chain(self.done.take())
    }

    /// Forgets a channel and returns whether an encoded message was discarded.
    pub(super) fn forget(&mut self, channel: u32) -> bool {
        self.remove(channel);
        let of_it = |out: &mut OutgoingRecord| out.channel == Some(channel);
        self.done.take_if(of_it).is_some()
    }
}
