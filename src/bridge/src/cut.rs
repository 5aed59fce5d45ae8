//! Messages being sent in fragments. Other frames are sent between two fragments of a message.

use std::collections::VecDeque;

use bytes::Bytes;
use rosbridge::{Format, Fragment, Id, Op, split_text};

use crate::outbox::TopicKey;
use crate::sample::EncodedFrame;

/// Maximum number of messages fragmented at the same time.
const MAX_CUTS: usize = 4;

#[derive(Default)]
pub(crate) struct Fragmenter {
    cuts: VecDeque<FragmentedMessage>,
    /// Number of messages fragmented so far, used as their ids.
    ids: i64,
    /// True if the next frame is to be a fragment: every other one is.
    due: bool,
}

struct FragmentedMessage {
    /// UTF-8 text; the frame's own bytes, not a copy.
    text: Bytes,
    at: usize,
    size: usize,
    id: i64,
    num: u64,
    total: u64,
    key: Option<TopicKey>,
}

impl Fragmenter {
    /// Returns whether a frame would be fragmented: a text longer than `size`.
    pub(crate) fn is_long(frame: &EncodedFrame, size: Option<usize>) -> bool {
        frame.format == Format::Json && size.is_some_and(|size| frame.bytes.len() > size)
    }

    /// Adds a frame if it is a text longer than `size`; returns whether it was added.
    pub(crate) fn add_if_long(&mut self, frame: &EncodedFrame, size: Option<usize>, key: Option<TopicKey>) -> bool {
        let Some(size) = size.filter(|_| Self::is_long(frame, size)) else {
            return false;
        };
        let Ok(text) = std::str::from_utf8(&frame.bytes) else {
            return false;
        };
        let total = split_text(text, size).count() as u64;
        self.ids += 1;
        self.cuts.push_back(FragmentedMessage {
            text: frame.bytes.clone(),
            at: 0,
            size,
            id: self.ids,
            num: 0,
            total,
            key,
        });
        true
    }

    /// Returns whether no more messages should be added.
    pub(crate) fn is_full(&self) -> bool {
        self.cuts.len() >= MAX_CUTS
    }

    pub(crate) fn is_due(&self) -> bool {
        self.due && !self.cuts.is_empty()
    }

    /// Notes that another frame was sent, so that the next one is a fragment.
    pub(crate) fn make_due(&mut self) {
        self.due = true;
    }

    /// Returns the next fragment of the message whose turn it is; for its last fragment with its topic.
    pub(crate) fn next(&mut self) -> Option<(Bytes, Option<TopicKey>)> {
        self.due = false;
        let mut cut = self.cuts.pop_front()?;
        let piece = split_text(utf8_prefix(&cut.text[cut.at..], cut.size), cut.size).next()?;
        let mut out = Vec::with_capacity(piece.len() + piece.len() / 8 + 64);
        let fragment = Fragment { id: Id::Integer(cut.id), data: piece.into(), num: cut.num, total: cut.total };
        cut.at += piece.len();
        cut.num += 1;
        Op::from(fragment).print(&mut out, Format::Json);
        if cut.num == cut.total {
            return Some((out.into(), cut.key));
        }
        self.cuts.push_back(cut);
        Some((out.into(), None))
    }
}

/// Returns a prefix of a UTF-8 text: `size` bytes, rounded down to whole characters, but at least one character.
fn utf8_prefix(text: &[u8], size: usize) -> &str {
    // A character has at most 4 bytes.
    let window = &text[..size.max(4).min(text.len())];
    match std::str::from_utf8(window) {
        Ok(window) => window,
        Err(error) => std::str::from_utf8(&window[..error.valid_up_to()]).unwrap_or_default(),
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use rosbridge::{FragmentLimits, Fragments, ProtocolFrame as Incoming};

    use super::*;

    #[test]
    fn cut_messages_take_turns_and_come_whole() {
        let texts = ["grüße ".repeat(100), "kurz ".repeat(50)];
        let mut cuts = Fragmenter::default();
        for (key, text) in texts.iter().enumerate() {
            let frame = EncodedFrame { format: Format::Json, bytes: text.clone().into() };
            assert!(cuts.add_if_long(&frame, Some(99), Some(key as u64)));
            assert!(!cuts.add_if_long(&frame, Some(10_000), None));
        }
        let limits = FragmentLimits { age: Duration::from_secs(1), ..FragmentLimits::default() };
        let mut fragments = Fragments::new(limits);
        let mut whole = Vec::new();
        let mut ends = Vec::new();
        let mut ids = Vec::new();
        while let Some((bytes, end)) = cuts.next() {
            ends.extend(end);
            let Ok(Op::Fragment(fragment)) = Op::parse(Incoming::Text(std::str::from_utf8(&bytes).unwrap())) else {
                panic!("not a fragment")
            };
            ids.push(fragment.id.to_string());
            whole.extend(fragments.add(&fragment, Instant::now()).unwrap());
        }
        assert_eq!(ids[..4], ["1", "2", "1", "2"]);
        assert_eq!(ends, [1, 0]);
        assert_eq!(whole, [texts[1].clone(), texts[0].clone()]);
    }
}
