//! From records to frames: what goes next, in which pieces, and what is kept in case it is lost. No I/O, no clock of
//! its own.
//!
//! ```text
//!  urgent (control, calls, answers) ─┐
//!  topic 7 ─ small ─ small ──────────┼─▶ next(): urgent, then small ones in turns, then a piece of a big one
//!  topic 9 ─ big ────────────────────┘        (after SMALL_IN_A_ROW small ones a piece all the same)
//! ```
//! Deciding late is the point: the socket is given little at a time, so a newer picture can still replace one that
//! waits, and a small message never waits for more than a piece.

mod budget;
mod encoding;
mod out;
mod retransmit;

use std::collections::{BTreeMap, VecDeque};

use ::budget::{Budget, Permit};
use ros::ring::{Bounds, Held, Ring};
use ros::turns::Turns;

use crate::drops::{Cause, Tally};
use crate::frame::Frame;
use crate::record::{LEFT_AT, Record};
use encoding::Encoding;
use out::Out;
use retransmit::{Retransmit, Sent};

/// Records up to this size go in one piece, and are kept until the peer has them.
pub(crate) const SMALL: usize = 32 * 1024;
/// Pieces are made so long that one takes about this on the link as measured, seconds.
const PIECE_TIME: f64 = 0.008;
/// The least and the greatest size of a piece, bytes.
const PIECES: (usize, usize) = (4 * 1024, 64 * 1024);
/// Before the link was measured.
const FIRST_PIECE: usize = 32 * 1024;
const SMALL_IN_A_ROW: u32 = 16;
/// What waits on one topic; the oldest give way. One always stays.
const WAITING: Bounds = Bounds {
    messages: 256,
    bytes: 2 << 20,
};
/// The same once a big message waits: only the newest counts.
const BIG_WAITING: Bounds = Bounds {
    messages: 1,
    ..WAITING
};
/// Urgent records that may wait and be kept until the peer has them, and their bytes: beyond, the session is given up. A single
/// one may have any size.
const MAX_URGENT: usize = 65_536;
const MAX_URGENT_BYTES: usize = 512 << 20;
/// How a message may be treated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quality {
    /// A newer one may take its place.
    Newest,
    /// Every one counts (latched messages, actions): never dropped for its age.
    Each,
}

#[derive(Debug)]
struct Sending {
    stream: u32,
    number: u64,
    /// It is sent again after a lost connection.
    again: bool,
    at: usize,
    out: Out,
}

/// What goes out over the life of a session.
#[derive(Debug)]
pub(crate) struct Outgoing {
    next_number: u64,
    next_stream: u32,
    urgent: Ring<Out>,
    topics: BTreeMap<u32, Ring<Out>>,
    /// Topics with something to send; one with a big message under way, or one that is being encoded, is held.
    turns: Turns<u32>,
    sending: VecDeque<Sending>,
    retransmit: Retransmit,
    /// For all that waits and is kept, but for the last `uncounted` bytes.
    permit: Permit,
    uncounted: usize,
    /// Why the session must be given up.
    full: Option<String>,
    in_a_row: u32,
    pub(crate) encoding: Encoding,
    piece: usize,
    max_age: Option<i64>,
    /// Messages dropped so far, by channel.
    pub(crate) dropped: Tally<u32>,
    /// Channels that the peer knows to be closed.
    pub(crate) closed: Vec<u32>,
    /// Bytes of records given to the socket, over the session.
    pub(crate) sent: u64,
}

impl Outgoing {
    pub(crate) fn new(max_age: Option<i64>) -> Self {
        Self {
            next_number: 1,
            next_stream: 0,
            urgent: Ring::unbounded(),
            topics: BTreeMap::new(),
            turns: Turns::default(),
            sending: VecDeque::new(),
            retransmit: Retransmit::default(),
            permit: Budget::unlimited().permit(),
            uncounted: 0,
            full: None,
            in_a_row: 0,
            encoding: Encoding::default(),
            piece: FIRST_PIECE,
            max_age,
            dropped: Tally::default(),
            closed: Vec::new(),
            sent: 0,
        }
    }

    /// Counts what waits and is kept in `budget`. Messages that do not fit are dropped; an urgent record that does not fit is
    /// the end of the session.
    pub(crate) fn within(&mut self, budget: &Budget) {
        self.permit = budget.permit();
    }

    /// Why more waits than may: the peer does not take what it must, or does not say that it has.
    pub(crate) fn is_full(&self) -> Option<&str> {
        self.full.as_deref()
    }

    pub(crate) fn push(&mut self, record: &Record, quality: Quality) {
        let out = Out::of(record, quality);
        let Some(channel) = out.channel else {
            if self.takes_urgent(out.held()) {
                self.urgent.append(out);
            }
            return;
        };
        if !self.takes_message(channel, out.held()) {
            return;
        }
        let topic = topic(&mut self.topics, channel);
        // A big message is only ever worth sending while it is the newest.
        let limit = match out.is_big() {
            true => BIG_WAITING,
            false => WAITING,
        };
        topic.append(out);
        let replaced = topic.trim(|topic| {
            let may = |out: &Out| !out.each || topic.len() > WAITING.messages;
            let mut older = topic.iter().take(topic.len() - 1);
            topic.exceeds(limit).then(|| older.position(may))?
        });
        self.dropped
            .add(channel, Cause::Replaced, replaced.messages);
        self.turns.join(channel);
        if quality == Quality::Each {
            self.keep_to_budget(channel);
        }
    }

    /// Ends a channel by this record, after all that waits on it.
    pub(crate) fn close(&mut self, channel: u32, record: &Record) {
        let last = Out::closing(channel, record);
        topic(&mut self.topics, channel).append(last);
        self.turns.join(channel);
    }

    /// Whether the socket has all there is for it.
    pub(crate) fn is_idle(&self) -> bool {
        self.urgent.is_empty()
            && self.sending.is_empty()
            && !self.encoding.is_done()
            && (self.turns.is_empty() || self.encoding.is_busy())
    }

    /// Forgets what waits on a channel.
    pub(crate) fn forget(&mut self, channel: u32) {
        let waiting = self.topics.remove(&channel).map_or(0, |topic| topic.len());
        let encoded = self.encoding.forget(channel);
        self.dropped
            .add(channel, Cause::Gone, waiting as u64 + u64::from(encoded));
        self.turns.forget(channel);
    }

    /// Whether anything waits.
    pub(crate) fn is_empty(&self) -> bool {
        self.urgent.is_empty()
            && self.turns.is_empty()
            && self.sending.is_empty()
            && self.encoding.is_empty()
    }

    /// The next frame.
    pub(crate) fn next(&mut self, now: i64) -> Option<Frame> {
        if let Some(out) = self.urgent.pop().or_else(|| self.encoding.take_done()) {
            return Some(self.start(out, now));
        }
        let turn_for_big = self.in_a_row >= SMALL_IN_A_ROW && !self.sending.is_empty();
        let message = if turn_for_big {
            None
        } else {
            self.next_message(now)
        };
        if let Some(out) = message {
            self.in_a_row += 1;
            return Some(self.start(out, now));
        }
        self.in_a_row = 0;
        self.next_piece()
    }

    /// The next message in turn, without those that have become too old.
    fn next_message(&mut self, now: i64) -> Option<Out> {
        // One is encoded at a time; the others wait for it.
        let (encoding, topics) = (&mut self.encoding, &mut self.topics);
        let busy = encoding.is_busy();
        let channel = self.turns.take(|channel| {
            let first = topics.get(channel).and_then(Ring::front);
            !busy || first.is_none_or(|first| !encoding.wants(first))
        })?;
        let topic = topics.get_mut(&channel)?;
        let is_stale =
            |first: &Out| !first.each && self.max_age.is_some_and(|age| now - first.born > age);
        let stale = topic.trim(|topic| {
            let stale = topic.len() > 1 && topic.front().is_some_and(is_stale);
            stale.then_some(0)
        });
        self.dropped.add(channel, Cause::Stale, stale.messages);
        let out = topic.pop()?;
        if !encoding.wants(&out) {
            return Some(out);
        }
        if busy {
            // The one before it had grown too old.
            topic.put_back(out);
            self.turns.join(channel);
        } else {
            encoding.begin(out);
            self.turns.hold(channel);
        }
        None
    }

    /// The topic of a message that has left has its next turn.
    fn turn_after(&mut self, out: &Out) {
        let Some(channel) = out.channel else {
            return;
        };
        match self.topics.get(&channel) {
            None => self.turns.forget(channel),
            Some(topic) => {
                self.turns.release(channel);
                if !topic.is_empty() {
                    self.turns.join(channel);
                }
            }
        }
    }

    fn start(&mut self, mut out: Out, now: i64) -> Frame {
        if out.channel.is_some() && !out.closes {
            out.head[LEFT_AT..LEFT_AT + 8].copy_from_slice(&now.to_le_bytes());
        }
        let length = out.len();
        let again = self.retransmit.takes(&out);
        let number = if again || self.retransmit.len() < MAX_URGENT {
            self.next_number += 1;
            self.next_number - 1
        } else {
            0
        };
        if length <= SMALL {
            self.turn_after(&out);
            self.sent += length as u64;
            let record = out.piece(0, length);
            self.retransmit.add(number, again, out);
            return Frame::Whole { number, record };
        }
        // The topic waits until it is through.
        if let Some(channel) = out.channel {
            self.turns.hold(channel);
        }
        let stream = self.next_stream;
        self.next_stream = self.next_stream.wrapping_add(1);
        // On a quick link a piece may be longer than the record; the rest must not be empty.
        let bytes = out.piece(0, self.piece.min(length - 1));
        self.sent += bytes.len() as u64;
        let total = u32::try_from(length).unwrap_or(u32::MAX);
        let at = bytes.len();
        self.sending.push_back(Sending {
            stream,
            number,
            again,
            at,
            out,
        });
        Frame::Begin {
            stream,
            number,
            total,
            bytes,
        }
    }

    fn next_piece(&mut self) -> Option<Frame> {
        let mut sending = self.sending.pop_front()?;
        let bytes = sending.out.piece(sending.at, self.piece);
        sending.at += bytes.len();
        self.sent += bytes.len() as u64;
        let stream = sending.stream;
        if sending.at < sending.out.len() {
            self.sending.push_back(sending);
        } else {
            self.turn_after(&sending.out);
            self.retransmit
                .add(sending.number, sending.again, sending.out);
        }
        Some(Frame::More { stream, bytes })
    }

    /// The peer has all numbers up to this one.
    pub(crate) fn acknowledge(&mut self, number: u64) {
        while let Some(out) = self.retransmit.acknowledged(number) {
            // All that went before it has come, too.
            if let Some(channel) = out.channel.filter(|_| out.closes) {
                self.topics.remove(&channel);
                self.turns.forget(channel);
                self.encoding.remove(channel);
                self.closed.push(channel);
            }
        }
        self.count_less();
    }

    /// A message came and could not be decoded: where each one counts it goes once more, unless a newer one of a
    /// latched topic has gone. Says whether it does.
    pub(crate) fn again(&mut self, channel: u32, born: i64) -> bool {
        let Some(again) = self.retransmit.damaged(channel, born) else {
            return false;
        };
        topic(&mut self.topics, channel).put_back(again);
        self.turns.join(channel);
        true
    }

    /// The link carries so many bytes per second.
    pub(crate) fn set_throughput(&mut self, bytes_per_second: f64) {
        let piece = (bytes_per_second * PIECE_TIME) as usize;
        self.piece = piece.clamp(PIECES.0, PIECES.1);
    }

    /// Begins with this number, which the peer was told to expect.
    pub(crate) fn begin_at(&mut self, number: u64) {
        self.next_number = number;
    }

    /// The first number on the next connection.
    pub(crate) fn next_number(&self) -> u64 {
        self.next_number
    }

    /// A new connection, the peer having all up to `received` and those `ahead`: the rest of what was kept goes first,
    /// in order. Big messages that were under way are lost unless each one counts.
    pub(crate) fn reconnect(&mut self, received: u64, ahead: &[u64]) {
        for out in self.encoding.give_up() {
            if let Some(channel) = out.channel {
                let topic = topic(&mut self.topics, channel);
                if out.each || topic.is_empty() {
                    topic.put_back(out);
                } else {
                    self.dropped.add(channel, Cause::Replaced, 1);
                }
            }
        }
        for sending in std::mem::take(&mut self.sending) {
            self.retransmit
                .add(sending.number, sending.again, sending.out);
        }
        for (number, sent) in std::mem::take(&mut self.retransmit).into_records().rev() {
            if number <= received || ahead.contains(&number) {
                continue;
            }
            match sent {
                Sent::Once(channel) => self.dropped.add(channel, Cause::CutOff, 1),
                Sent::Again(out) => match out.channel {
                    None => self.urgent.put_back(out),
                    Some(channel) => topic(&mut self.topics, channel).put_back(out),
                },
            }
        }
        self.turns = Turns::default();
        let waiting = self.topics.iter().filter(|(_, topic)| !topic.is_empty());
        waiting.for_each(|(channel, _)| self.turns.join(*channel));
    }
}

/// What waits on a channel. Only this module drops something of it.
fn topic(topics: &mut BTreeMap<u32, Ring<Out>>, channel: u32) -> &mut Ring<Out> {
    topics.entry(channel).or_insert_with(Ring::unbounded)
}

#[cfg(test)]
mod tests;
