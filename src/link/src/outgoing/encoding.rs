//! Messages that are encoded before they are sent, one at a time.

use std::collections::BTreeSet;
use std::time::Duration;

use bytes::Bytes;

use super::out::Out;
use crate::record::{ENCODED, FLAGS_AT, SERIALISE_AT};

/// Smaller messages are not worth it.
const WORTH_IT: usize = 1024;

/// The message that is being encoded, and which others are to be.
#[derive(Debug, Default)]
pub(crate) struct Encoding {
    /// Messages of these channels, while it `pays`.
    channels: BTreeSet<u32>,
    pays: bool,
    /// And whether someone has taken that on.
    message: Option<(Out, bool)>,
    done: Option<Out>,
}

impl Encoding {
    /// Messages of this channel may be encoded.
    pub(crate) fn add(&mut self, channel: u32) {
        self.channels.insert(channel);
    }

    /// A channel whose messages may not be encoded ahead any more.
    pub(super) fn remove(&mut self, channel: u32) {
        self.channels.remove(&channel);
    }

    #[cfg(test)]
    pub(super) fn channels(&self) -> &BTreeSet<u32> {
        &self.channels
    }

    /// Whether encoding pays.
    pub(crate) fn set_pays(&mut self, pays: bool) {
        self.pays = pays;
    }

    /// Whether this message is to be encoded.
    pub(super) fn wants(&self, out: &Out) -> bool {
        let flags = out.head.get(FLAGS_AT);
        self.pays
            && out.payload.len() >= WORTH_IT
            && flags.is_some_and(|flags| flags & ENCODED == 0)
            && out
                .channel
                .is_some_and(|channel| self.channels.contains(&channel))
    }

    pub(super) fn begin(&mut self, out: Out) {
        self.message = Some((out, false));
    }

    /// A message to be encoded now: its channel, itself, and whether it must be understood alone.
    pub(crate) fn take(&mut self) -> Option<(u32, Bytes, bool)> {
        let (out, taken) = self.message.as_mut().filter(|(_, taken)| !taken)?;
        *taken = true;
        Some((out.channel?, out.payload.clone(), out.each))
    }

    /// It was encoded; none: it goes as it is.
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

    /// The message that was encoded, if it `may` go.
    pub(super) fn take_done(&mut self, may: impl FnOnce(&mut Out) -> bool) -> Option<Out> {
        self.done.take_if(may)
    }

    pub(super) fn is_done(&self) -> bool {
        self.done.is_some()
    }

    pub(super) fn is_busy(&self) -> bool {
        self.message.is_some()
    }

    pub(super) fn is_empty(&self) -> bool {
        !self.is_done() && !self.is_busy()
    }

    /// The messages that are and were encoded.
    pub(super) fn messages(&self) -> impl Iterator<Item = &Out> {
        self.message.iter().map(|(out, _)| out).chain(&self.done)
    }

    /// Gives them back.
    pub(super) fn give_up(&mut self) -> impl Iterator<Item = Out> + use<> {
        let message = self.message.take().map(|(out, _)| out);
        message.into_iter().chain(self.done.take())
    }

    /// The channel is gone; says whether a message of it was encoded in vain.
    pub(super) fn forget(&mut self, channel: u32) -> bool {
        self.remove(channel);
        let of_it = |out: &mut Out| out.channel == Some(channel);
        self.done.take_if(of_it).is_some()
    }
}
