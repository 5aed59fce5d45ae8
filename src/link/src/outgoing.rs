//! From records to frames: what goes next, in which pieces, and what is kept in case it is lost. No I/O, no clock of
//! its own.
//!
//! ```text
//!  control ───────── in order ─────────────────────┐
//!  calls and goals ─ in order ─────────────────────┤
//!  answers ───────── short ones, long ones ────────┼─▶ next(): short records, after SMALL_IN_A_ROW of them a piece of a
//!  data ──────────── a queue per topic, newest wins┤           long one; lines where nothing waits, and a small share else
//!  lines ─────────── the oldest give way, counted ─┘
//! ```
//! Of control, and of calls and goals, one record is under way at a time, so none overtakes another. A message waits for the opening of its
//! channel. The sender keeps to the peer's [`Limits`]: what the peer would not take waits here, or is left out and counted.
//!
//! Deciding late is the point: the socket is given little at a time, so a newer picture can still replace one that
//! waits, and a small message never waits for more than a piece.

mod budget;
mod data;
mod encoding;
mod gate;
mod lanes;
mod out;
mod retransmit;

use std::collections::{BTreeMap, VecDeque};

use ::budget::{Budget, Permit};
use ros::ring::{Held, Ring};
use ros::turns::Turns;

use crate::drops::{Cause, Tally};
use crate::frame::Frame;
use crate::limits::Limits;
use crate::record::{LEFT_AT, Record};
use encoding::Encoding;
use gate::Gate;
use lanes::{Lane, Lanes, Lines};
use out::Out;
pub use out::Quality;
use retransmit::Retransmit;

/// Records up to this size go in one piece, and are kept until the peer has them.
pub(crate) const SMALL: usize = 32 * 1024;
/// Pieces are made so long that one takes about this on the link as measured, seconds.
const PIECE_TIME: f64 = 0.008;
/// The least and the greatest size of a piece, bytes.
const PIECES: (usize, usize) = (4 * 1024, 64 * 1024);
/// The socket is given more only when it holds less than this: what is decided later is decided better.
const LOW_WATER: usize = 24 * 1024;
/// Before the link was measured.
const FIRST_PIECE: usize = 32 * 1024;
const SMALL_IN_A_ROW: u32 = 16;
/// Of so many short records in a row one is a message, if one waits, however many calls and answers do.
const TURN_OF_DATA: u32 = 4;
/// The part of the numbers that the peer takes ahead of a missing one which is used for what would not be sent again.
const UNKEPT_AHEAD: usize = 4;

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
    /// The peer has all numbers up to this one.
    acknowledged: u64,
    next_stream: u32,
    next_order: u64,
    /// What the peer takes.
    peer: Limits,
    lanes: Lanes,
    lines: Lines,
    topics: BTreeMap<u32, Ring<Out>>,
    /// The last order that was told before a channel's first message.
    openings: BTreeMap<u32, u64>,
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
            acknowledged: 0,
            next_stream: 0,
            next_order: 0,
            peer: Limits::default(),
            lanes: Lanes::default(),
            lines: Lines::default(),
            topics: BTreeMap::new(),
            openings: BTreeMap::new(),
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

    /// Counts what waits and is kept in `budget`. Messages and lines that do not fit are dropped; an order, call or answer that
    /// does not fit is the end of the session.
    pub(crate) fn within(&mut self, budget: &Budget) {
        self.permit = budget.permit();
    }

    /// Why more waits than may: the peer does not take what it must, or does not say that it has.
    pub(crate) fn is_full(&self) -> Option<&str> {
        self.full.as_deref()
    }

    /// The peer takes so much.
    pub(crate) fn set_limits(&mut self, peer: Limits) {
        self.peer = peer.raise();
    }

    /// The peer has been told of this channel by what was pushed before: no message of it comes earlier.
    pub(crate) fn opens(&mut self, channel: u32) {
        self.openings.insert(channel, self.next_order);
        self.encoding.add(channel);
    }

    pub(crate) fn push(&mut self, record: &Record, quality: Quality) {
        let lane = match record {
            Record::Control(_) => Lane::Control,
            Record::Answer { .. } => Lane::Answers,
            Record::Data(_) if quality != Quality::InOrder => Lane::Data,
            Record::Data(_) | Record::Call { .. } => Lane::Calls,
        };
        let mut out = self.number(Out::of(record, lane));
        out.each = quality != Quality::Newest;
        if lane == Lane::Answers && out.is_big() {
            out.lane = Lane::LongAnswers;
        }
        if out.len() > self.peer.record {
            let (bytes, limit) = (out.len(), self.peer.record);
            tracing::warn!(
                bytes,
                limit,
                "a record is longer than the other end of the link takes, and is left out"
            );
            if let Some(channel) = out.channel {
                self.dropped.add(channel, Cause::Full, 1);
            }
            return;
        }
        match out.channel.filter(|_| lane == Lane::Data) {
            Some(channel) => self.push_message(channel, out),
            None => self.push_required(out),
        }
    }

    /// Sends a line that a node has printed, when there is time.
    pub(crate) fn print(&mut self, line: &Record) {
        let line = self.number(Out::of(line, Lane::Lines));
        self.lines.push(line);
    }

    fn number(&mut self, out: Out) -> Out {
        self.next_order += 1;
        let order = self.next_order;
        Out { order, ..out }
    }

    /// Queues what must come. An order, call or answer beyond the limits is the end of the session: to leave one out would be to lose it.
    fn push_required(&mut self, out: Out) {
        if self.full.is_some() {
            return;
        }
        let bytes = out.held();
        let refused = self.lanes.refuse(out.lane, bytes);
        let refused = refused.or_else(|| Some(self.count_more(bytes).err()?.to_string()));
        match (refused, out.channel) {
            (None, _) => self.lanes.push(out),
            (Some(_), Some(channel)) => self.dropped.add(channel, Cause::Full, 1),
            (refused, None) => self.full = refused,
        }
    }

    /// Whether the socket has all there is for it.
    pub(crate) fn is_idle(&self) -> bool {
        self.lanes.is_empty()
            && self.lines.is_empty()
            && self.sending.is_empty()
            && !self.encoding.is_done()
            && (self.turns.is_empty() || self.encoding.is_busy())
    }

    /// Whether anything waits.
    pub(crate) fn is_empty(&self) -> bool {
        self.lanes.is_empty()
            && self.lines.is_empty()
            && self.turns.is_empty()
            && self.sending.is_empty()
            && self.encoding.is_empty()
    }

    /// How many messages wait on each topic.
    #[cfg(test)]
    pub(crate) fn waiting(&self) -> impl Iterator<Item = usize> {
        self.topics.values().map(Ring::len)
    }

    /// The next frame.
    pub(crate) fn next(&mut self, now: i64) -> Option<Frame> {
        if self.unacknowledged() >= self.peer.ahead {
            // The peer takes no further number before what is under way has come.
            return self.next_piece();
        }
        if let Some(line) = self.next_line(false) {
            return Some(self.start(line, now));
        }
        let is_turn_of_long = self.in_a_row >= SMALL_IN_A_ROW && !self.sending.is_empty();
        let next = if is_turn_of_long {
            None
        } else {
            self.next_record(now)
        };
        if let Some(out) = next {
            self.in_a_row = self.in_a_row.wrapping_add(1);
            return Some(self.start(out, now));
        }
        self.in_a_row = 0;
        if let Some(piece) = self.next_piece() {
            return Some(piece);
        }
        let line = self.next_line(true)?;
        Some(self.start(line, now))
    }

    fn next_line(&mut self, is_alone: bool) -> Option<Out> {
        let gate = Gate::new(&self.sending, &self.lanes, &self.openings, self.peer);
        self.lines.take(is_alone, |out| gate.lets(out))
    }

    /// Numbers that were used and that the peer has not said to have, all before them included.
    pub(crate) fn unacknowledged(&self) -> usize {
        usize::try_from(self.next_number - 1 - self.acknowledged).unwrap_or(usize::MAX)
    }

    fn next_record(&mut self, now: i64) -> Option<Out> {
        let is_turn_of_data = self.in_a_row % TURN_OF_DATA == TURN_OF_DATA - 1;
        let data = if is_turn_of_data {
            self.next_data(now)
        } else {
            None
        };
        let gate = Gate::new(&self.sending, &self.lanes, &self.openings, self.peer);
        let place = data
            .is_none()
            .then(|| self.lanes.first(|out| gate.lets(out)));
        let required = place.flatten().and_then(|lane| self.lanes.take(lane));
        data.or(required).or_else(|| self.next_data(now))
    }

    fn start(&mut self, mut out: Out, now: i64) -> Frame {
        if out.channel.is_some() && !out.closes {
            out.head[LEFT_AT..LEFT_AT + 8].copy_from_slice(&now.to_le_bytes());
        }
        let length = out.len();
        let again = self.retransmit.takes(&out);
        let number = if again || self.unacknowledged() < self.peer.ahead / UNKEPT_AHEAD {
            self.next_number += 1;
            self.next_number - 1
        } else {
            0
        };
        if length <= SMALL {
            self.turn_after(&out);
            let record = out.piece(0, length);
            self.count_sent(out.lane, length);
            self.retransmit.add(number, again, out);
            return Frame::Whole { number, record };
        }
        // The topic waits until it is through.
        if let Some(channel) = out.channel.filter(|_| out.lane == Lane::Data) {
            self.turns.hold(channel);
        }
        let stream = self.next_stream;
        self.next_stream = self.next_stream.wrapping_add(1);
        // On a quick link a piece may be longer than the record; the rest must not be empty.
        let bytes = out.piece(0, self.piece.min(length - 1));
        self.count_sent(out.lane, bytes.len());
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

    fn count_sent(&mut self, lane: Lane, bytes: usize) {
        self.sent += bytes as u64;
        if lane != Lane::Lines {
            self.lines.earn(bytes);
        }
    }

    fn next_piece(&mut self) -> Option<Frame> {
        let mut sending = self.sending.pop_front()?;
        let bytes = sending.out.piece(sending.at, self.piece);
        sending.at += bytes.len();
        self.count_sent(sending.out.lane, bytes.len());
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

    /// The link carries so many bytes per second.
    pub(crate) fn set_throughput(&mut self, bytes_per_second: f64) {
        let piece = (bytes_per_second * PIECE_TIME) as usize;
        self.piece = piece.clamp(PIECES.0, PIECES.1);
    }

    /// Bytes that the socket is to hold before it is given no more: what waits in it, a small message waits for.
    pub(crate) fn low_water(&self) -> usize {
        LOW_WATER.min(2 * self.piece)
    }

    /// Begins with this number, which the peer was told to expect.
    pub(crate) fn begin_at(&mut self, number: u64) {
        self.next_number = number.max(1);
        self.acknowledged = self.next_number - 1;
    }

    /// The first number on the next connection.
    pub(crate) fn next_number(&self) -> u64 {
        self.next_number
    }
}

#[cfg(test)]
mod tests;
