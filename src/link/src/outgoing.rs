//! The send side of a session: decides which frame is sent next, splits records into pieces, and keeps what may have to
//! be sent again. No I/O, no clock of its own.
//!
//! ```text
//!  control ───────── in order ─────────────────────┐
//!  calls and goals ─ in order ─────────────────────┤
//!  responses ─────── short ones, long ones ────────┼─▶ next(): short records, after SMALL_IN_A_ROW of them a piece
//!  data ──────────── a queue per topic, newest wins┤           of a long one; lines when idle, plus a small share
//!  lines ─────────── the oldest are dropped ───────┘
//! ```
//! One control record and one call or goal are in flight at a time, so that none overtakes another. A message waits
//! until its channel has been opened. The sender stays within the peer's [`LinkLimits`]: what the peer would not accept
//! is queued here, or dropped and counted.
//!
//! Decisions are made as late as possible: the socket is given little at a time, so that a newer image can still
//! replace a queued one, and a small message never waits for more than one piece.

mod budget;
mod data;
mod encoding;
mod gate;
mod lanes;
mod outgoing_record;
mod retransmit;

use std::collections::{BTreeMap, VecDeque};

use ::budget::Permit;
use ros::ring::{Ring, RingItem};
use ros::turns::RoundRobin;

use crate::drops::{Cause, Tally};
use crate::frame::Frame;
use crate::limits::LinkLimits;
use crate::record::{LEFT_AT, Record};
use encoding::Encoding;
use lanes::{RecordLane, RecordLanes};
pub use outgoing_record::DeliveryMode;
use outgoing_record::{InFlightRecord, OutgoingRecord, SMALL};
use retransmit::SentRecord;

/// Target transmission time of a piece at the measured throughput, in seconds.
const PIECE_TIME: f64 = 0.008;
/// Minimum and maximum size of a piece in bytes.
const PIECES: (usize, usize) = (4 * 1024, 64 * 1024);
/// The socket buffer is refilled when it holds less than this; late decisions are better decisions.
const LOW_WATER: usize = 24 * 1024;
/// Size of a piece before the throughput was measured.
const FIRST_PIECE: usize = 32 * 1024;
const SMALL_IN_A_ROW: u32 = 16;
/// One of this many short records in a row is a topic message, if one is queued, regardless of the number of calls and
/// responses.
const TURN_OF_DATA: u32 = 4;
/// Divisor of the peer's limit on numbers ahead: the part that may be used for records that are not kept for
/// retransmission.
const UNKEPT_AHEAD: usize = 4;

/// Send state of a session.
#[derive(Debug, Default)]
pub(crate) struct Outgoing {
    /// The last record number in use.
    numbered: u64,
    /// The peer has acknowledged all numbers up to this one.
    acknowledged: u64,
    next_stream: u32,
    next_order: u64,
    /// Limits of the peer.
    peer: LinkLimits,
    lanes: RecordLanes,
    pub(crate) topics: BTreeMap<u32, Ring<OutgoingRecord>>,
    /// Number of the last control record that was pushed before each channel's first message.
    openings: BTreeMap<u32, u64>,
    /// Topics with something to send, perhaps after a message that is in flight or being encoded.
    turns: RoundRobin<u32>,
    sending: VecDeque<InFlightRecord>,
    /// Records that were sent and not yet acknowledged, by number.
    retransmit: VecDeque<SentRecord>,
    /// Memory permit for everything queued and kept, except for the last `uncounted` bytes; `None`: without a limit.
    pub(crate) permit: Option<Permit>,
    uncounted: usize,
    /// Reason to close the session: more is queued than allowed, because the peer does not receive what it must, or
    /// does not acknowledge it.
    pub(crate) overflow_reason: Option<String>,
    in_a_row: u32,
    pub(crate) encoding: Encoding,
    /// Size of a piece, once the throughput was measured.
    piece: Option<usize>,
    max_age: Option<i64>,
    /// Dropped messages by channel.
    pub(crate) dropped: Tally<u32>,
    /// Channels whose closing was acknowledged by the peer.
    pub(crate) closed: Vec<u32>,
    /// Bytes of records given to the socket in this session.
    pub(crate) sent: u64,
}

impl Outgoing {
    pub(crate) fn new(max_age: Option<i64>) -> Self {
        Self { max_age, ..Self::default() }
    }

    /// Sets the limits announced by the peer.
    pub(crate) fn set_limits(&mut self, peer: LinkLimits) {
        self.peer = peer.with_minimums();
    }

    /// Returns the limits of the peer.
    pub(crate) fn peer_limits(&self) -> LinkLimits {
        self.peer
    }

    /// Marks a channel as announced by the control record pushed before: no message of the channel is sent earlier.
    pub(crate) fn open_channel(&mut self, channel: u32) {
        self.order_after_control(channel);
        self.encoding.channels.insert(channel);
    }

    /// Makes messages of a channel wait for the control records pushed before.
    pub(crate) fn order_after_control(&mut self, channel: u32) {
        self.openings.insert(channel, self.next_order);
    }

    pub(crate) fn push(&mut self, record: &Record, quality: DeliveryMode) {
        let lane = match record {
            Record::Control(_) => RecordLane::Control,
            Record::Answer { .. } => RecordLane::Answers,
            Record::Data(_) if quality != DeliveryMode::InOrder => RecordLane::Data,
            Record::Data(_) | Record::Call(_) => RecordLane::Calls,
        };
        let mut out = self.assign_order(OutgoingRecord::new(record, lane));
        out.each = quality != DeliveryMode::Newest;
        if lane == RecordLane::Answers && out.is_big() {
            out.lane = RecordLane::LongAnswers;
        }
        if out.len() > self.peer.record {
            let (bytes, limit) = (out.len(), self.peer.record);
            tracing::warn!(bytes, limit, "a record is longer than the other end of the link accepts, and was dropped");
            if let Some(channel) = out.channel {
                self.dropped.add(channel, Cause::Full, 1);
            }
            return;
        }
        match out.channel.filter(|_| lane == RecordLane::Data) {
            Some(channel) => self.push_message(channel, out),
            None => self.push_required(out),
        }
    }

    /// Queues a line printed by a node; it is sent when there is spare capacity.
    pub(crate) fn push_line(&mut self, line: &Record) {
        let line = self.assign_order(OutgoingRecord::new(line, RecordLane::Lines));
        self.lanes.push_line(line);
    }

    /// Queues the last control message, and ahead of it the newest lines, which say why it is the last one.
    pub(crate) fn push_last(&mut self, record: &Record) {
        for line in self.lanes.take_last_lines() {
            let line = self.assign_order(OutgoingRecord { lane: RecordLane::Control, ..line });
            self.push_required(line);
        }
        self.push(record, DeliveryMode::Each);
    }

    fn assign_order(&mut self, out: OutgoingRecord) -> OutgoingRecord {
        self.next_order += 1;
        OutgoingRecord { order: self.next_order, ..out }
    }

    /// Queues a record that must be delivered. A control message, call or response beyond the limits ends the session,
    /// because omitting it would lose it.
    fn push_required(&mut self, out: OutgoingRecord) {
        if self.overflow_reason.is_some() {
            return;
        }
        let bytes = out.memory_size();
        let refused = self.lanes.overflow_reason(out.lane, bytes);
        let refused = refused.or_else(|| Some(self.charge(bytes).err()?.to_string()));
        match (refused, out.channel) {
            (None, _) => self.lanes.push(out),
            (Some(_), Some(channel)) => self.dropped.add(channel, Cause::Full, 1),
            (refused, None) => self.overflow_reason = refused,
        }
    }

    /// Returns whether the socket has been given everything that can be sent.
    pub(crate) fn is_idle(&self) -> bool {
        self.lanes.is_empty()
            && self.sending.is_empty()
            && self.encoding.encoded_message().is_none()
            && (self.turns.is_empty() || self.encoding.message().is_some())
    }

    /// Returns whether nothing is queued.
    pub(crate) fn is_empty(&self) -> bool {
        self.lanes.is_empty() && self.turns.is_empty() && self.sending.is_empty() && self.encoding.message().is_none()
    }

    /// Returns the next frame to send.
    pub(crate) fn next(&mut self, now: i64) -> Option<Frame> {
        if self.unacknowledged_count() >= self.peer.ahead {
            // The peer accepts no further number until the records in flight are complete.
            return self.next_piece();
        }
        if let Some(line) = self.next_line(false) {
            return Some(self.start(line, now));
        }
        let is_turn_of_long = self.in_a_row >= SMALL_IN_A_ROW && !self.sending.is_empty();
        let next = if is_turn_of_long { None } else { self.next_record(now) };
        if let Some(out) = next {
            self.in_a_row = self.in_a_row.wrapping_add(1);
            return Some(self.start(out, now));
        }
        self.in_a_row = 0;
        self.next_piece().or_else(|| {
            let line = self.next_line(true)?;
            Some(self.start(line, now))
        })
    }

    fn next_line(&mut self, is_alone: bool) -> Option<OutgoingRecord> {
        let first = self.lanes.records_of(RecordLane::Lines).next()?;
        // A line that is not kept must be missed if it is lost.
        let is_numbered = self.has_spare_numbers() || self.should_keep(first);
        let may = is_numbered && self.allows(first);
        may.then(|| self.lanes.take_line(is_alone)).flatten()
    }

    /// Returns whether records may have a number that are not kept for retransmission.
    fn has_spare_numbers(&self) -> bool {
        self.unacknowledged_count() < self.peer.ahead / UNKEPT_AHEAD
    }

    /// Returns the number of record numbers in use that the peer has not acknowledged.
    pub(crate) fn unacknowledged_count(&self) -> usize {
        usize::try_from(self.numbered - self.acknowledged).unwrap_or(usize::MAX)
    }

    fn next_record(&mut self, now: i64) -> Option<OutgoingRecord> {
        let is_turn_of_data = self.in_a_row % TURN_OF_DATA == TURN_OF_DATA - 1;
        let data = if is_turn_of_data { self.next_data(now) } else { None };
        let place = data.is_none().then(|| self.lanes.first_ready(|out| self.allows(out)));
        let required = place.flatten().and_then(|lane| self.lanes.take(lane));
        data.or(required).or_else(|| self.next_data(now))
    }

    fn start(&mut self, mut out: OutgoingRecord, now: i64) -> Frame {
        if out.channel.is_some() && !out.closes {
            out.head[LEFT_AT..LEFT_AT + 8].copy_from_slice(&now.to_le_bytes());
        }
        let length = out.len();
        let again = self.should_keep(&out);
        let is_numbered = again || self.has_spare_numbers();
        self.numbered += u64::from(is_numbered);
        let number = if is_numbered { self.numbered } else { 0 };
        if self.fits_one_frame(&out) {
            let record = out.piece(0, length);
            self.count_sent(out.lane, length);
            self.note_sent(number, again, out);
            return Frame::Whole { number, record };
        }
        let stream = self.next_stream;
        self.next_stream = self.next_stream.wrapping_add(1);
        // On a fast link a piece may be longer than the record; the rest must not be empty.
        let bytes = out.piece(0, self.piece().min(length - 1));
        self.count_sent(out.lane, bytes.len());
        let total = u32::try_from(length).unwrap_or(u32::MAX);
        self.sending.push_back(InFlightRecord { stream, number, again, at: bytes.len(), out });
        Frame::Begin { stream, number, total, bytes }
    }

    fn count_sent(&mut self, lane: RecordLane, bytes: usize) {
        self.sent += bytes as u64;
        if lane != RecordLane::Lines {
            self.lanes.earn_credit(bytes);
        }
    }

    fn next_piece(&mut self) -> Option<Frame> {
        let mut sending = self.sending.pop_front()?;
        let bytes = sending.out.piece(sending.at, self.piece());
        sending.at += bytes.len();
        self.count_sent(sending.out.lane, bytes.len());
        let stream = sending.stream;
        if sending.at < sending.out.len() {
            self.sending.push_back(sending);
        } else {
            self.note_sent(sending.number, sending.again, sending.out);
        }
        Some(Frame::More { stream, bytes })
    }

    /// Sets the size of pieces for a link with this throughput.
    pub(crate) fn set_throughput(&mut self, bytes_per_second: f64) {
        let piece = (bytes_per_second * PIECE_TIME) as usize;
        self.piece = Some(piece.clamp(PIECES.0, PIECES.1));
    }

    /// Returns whether a record is sent in one frame: a short one, but on a slow link no message for which others would
    /// wait much longer than for a piece.
    fn fits_one_frame(&self, out: &OutgoingRecord) -> bool {
        let longest = if out.lane == RecordLane::Data && !out.closes { SMALL.min(2 * self.piece()) } else { SMALL };
        out.len() <= longest
    }

    fn piece(&self) -> usize {
        self.piece.unwrap_or(FIRST_PIECE)
    }

    /// Returns the level in bytes below which the socket buffer is refilled; a small message waits for what is in it.
    pub(crate) fn low_water(&self) -> usize {
        LOW_WATER.min(2 * self.piece())
    }

    /// Starts numbering at this number, which was announced to the peer.
    pub(crate) fn begin_at(&mut self, number: u64) {
        self.numbered = number.saturating_sub(1);
        self.acknowledged = self.numbered;
    }

    /// Returns the first number of the next connection.
    pub(crate) fn next_number(&self) -> u64 {
        self.numbered + 1
    }
}

#[cfg(test)]
mod tests;
