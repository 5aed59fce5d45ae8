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

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

use ::budget::{Budget, Permit};
use bytes::{BufMut, Bytes, BytesMut};

use crate::drops::Cause;
use crate::frame::Frame;
use crate::record::{ENCODED, FLAGS_AT, LEFT_AT, Record, SERIALISE_AT};

/// Records up to this size go in one piece, and are kept until the peer has them.
pub(crate) const SMALL: usize = 32 * 1024;
/// Pieces are made so long that one takes about this on the link as measured …
const PIECE_TIME: f64 = 0.008;
/// … between these.
const PIECES: (usize, usize) = (4 * 1024, 64 * 1024);
/// Before the link was measured.
const FIRST_PIECE: usize = 32 * 1024;
const SMALL_IN_A_ROW: u32 = 16;
/// Messages that wait on one topic, and their bytes; the oldest give way. One always stays.
const WAITING: (usize, usize) = (256, 2 << 20);
/// Big messages that wait on one topic: only the newest counts.
const BIG_WAITING: usize = 1;
/// Records kept in case they are lost, and their bytes. Messages beyond are not sent again.
const KEPT: (usize, usize) = (2048, 4 << 20);
/// Urgent records that may wait and be kept until the peer has them, and their bytes: beyond, the session is given up. A single
/// one may have any size.
const MAX_URGENT: usize = 65_536;
const MAX_URGENT_BYTES: usize = 512 << 20;
/// Smaller messages are not worth encoding.
const WORTH_PACKING: usize = 1024;

/// How a message may be treated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quality {
    /// A newer one may take its place.
    Newest,
    /// Every one counts (latched messages, actions): never dropped for its age.
    Each,
}

/// Messages dropped so far, by channel and cause.
pub(crate) type Dropped = BTreeMap<(u32, Cause), u64>;

/// What the peer was sent and has not said to have.
#[derive(Debug)]
enum Kept {
    /// It is sent again after a lost connection.
    Again(Out),
    /// It is not: too much was kept already, or a newer one will come. Of this channel.
    Not(u32),
}

#[derive(Debug, Clone)]
struct Out {
    head: BytesMut,
    payload: Bytes,
    born: i64,
    each: bool,
    /// The topic's channel; none: urgent.
    channel: Option<u32>,
    /// The message before it was encoded, where each one counts: it may come damaged.
    plain: Option<Bytes>,
    /// No message: the last record of its channel, which tells that there will be no more.
    closes: bool,
}

impl Out {
    fn len(&self) -> usize {
        self.head.len() + self.payload.len()
    }

    /// Bytes of memory, with the message before it was encoded.
    fn held(&self) -> usize {
        self.len() + self.plain.as_ref().map_or(0, Bytes::len)
    }

    fn is_big(&self) -> bool {
        self.held() > SMALL
    }

    /// Bytes from `at` on, at most `length`.
    fn piece(&self, at: usize, length: usize) -> Bytes {
        let end = (at + length).min(self.len());
        let head = self.head.len();
        if at >= head {
            return self.payload.slice(at - head..end - head);
        }
        let mut piece = BytesMut::with_capacity(end - at);
        piece.put_slice(&self.head[at..end.min(head)]);
        piece.put_slice(&self.payload[..end.saturating_sub(head)]);
        piece.freeze()
    }
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
    urgent: VecDeque<Out>,
    urgent_bytes: usize,
    topics: BTreeMap<u32, VecDeque<Out>>,
    /// Topics with something to send that is not under way.
    turns: VecDeque<u32>,
    sending: VecDeque<Sending>,
    kept: VecDeque<(u64, Kept)>,
    kept_bytes: usize,
    /// Of urgent records.
    kept_urgent: usize,
    /// Of big messages that count one by one.
    kept_big: usize,
    /// For all that waits and is kept, but for the last `uncounted` bytes.
    permit: Permit,
    uncounted: usize,
    /// Why the session must be given up.
    full: Option<String>,
    in_a_row: u32,
    /// Messages of these topics are encoded before they are sent, while `packs`.
    packable: BTreeSet<u32>,
    packs: bool,
    /// The message that is being encoded, and whether someone has taken that on.
    packing: Option<(Out, bool)>,
    packed: Option<Out>,
    piece: usize,
    max_age: Option<i64>,
    pub(crate) dropped: Dropped,
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
            urgent: VecDeque::new(),
            urgent_bytes: 0,
            topics: BTreeMap::new(),
            turns: VecDeque::new(),
            sending: VecDeque::new(),
            kept: VecDeque::new(),
            kept_bytes: 0,
            kept_urgent: 0,
            kept_big: 0,
            permit: Budget::unlimited().permit(),
            uncounted: 0,
            full: None,
            in_a_row: 0,
            packable: BTreeSet::new(),
            packs: false,
            packing: None,
            packed: None,
            piece: FIRST_PIECE,
            max_age,
            dropped: Dropped::default(),
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
        let (head, payload) = record.parts();
        let (channel, born) = match record {
            Record::Data(data) => (Some(data.channel), data.born),
            _ => (None, 0),
        };
        let out = Out {
            head,
            payload,
            born,
            each: quality == Quality::Each,
            channel,
            plain: None,
            closes: false,
        };
        let Some(channel) = channel else {
            if self.takes_urgent(out.len()) {
                self.urgent_bytes += out.len();
                self.urgent.push_back(out);
            }
            return;
        };
        if !self.takes_message(channel, out.len()) {
            return;
        }
        let topic = self.topics.entry(channel).or_default();
        let small = out.len() <= SMALL;
        topic.push_back(out);
        // A big message is only ever worth sending while it is the newest.
        let limit = if small { WAITING.0 } else { BIG_WAITING };
        let mut bytes: usize = topic.iter().map(Out::len).sum();
        while topic.len() > limit || (topic.len() > 1 && bytes > WAITING.1) {
            let Some(at) = topic
                .iter()
                .position(|out| !out.each || topic.len() > WAITING.0)
            else {
                break;
            };
            if at + 1 == topic.len() {
                break;
            }
            bytes -= topic.remove(at).map_or(0, |gone| gone.len());
            count(&mut self.dropped, channel, Cause::Replaced);
        }
        if topic.len() == 1 && !self.is_under_way(channel) {
            self.turns.push_back(channel);
        }
        if quality == Quality::Each {
            self.keep_to_budget(channel);
        }
    }

    /// Ends a channel by this record, after all that waits on it.
    pub(crate) fn close(&mut self, channel: u32, record: &Record) {
        let (head, payload) = record.parts();
        let topic = self.topics.entry(channel).or_default();
        topic.push_back(Out {
            head,
            payload,
            born: 0,
            each: true,
            channel: Some(channel),
            plain: None,
            closes: true,
        });
        if topic.len() == 1 && !self.is_under_way(channel) {
            self.turns.push_back(channel);
        }
    }

    fn is_under_way(&self, channel: u32) -> bool {
        let sending = self.sending.iter().map(|sending| &sending.out);
        let packing = self.packing.iter().map(|(out, _)| out);
        sending
            .chain(packing)
            .chain(&self.packed)
            .any(|out| out.channel == Some(channel))
    }

    /// Messages of this topic may be encoded.
    pub(crate) fn set_packable(&mut self, channel: u32) {
        self.packable.insert(channel);
    }

    /// Whether encoding pays.
    pub(crate) fn set_packs(&mut self, packs: bool) {
        self.packs = packs;
    }

    fn to_be_packed(&self, out: &Out) -> bool {
        self.packs
            && out.payload.len() >= WORTH_PACKING
            && out
                .head
                .get(FLAGS_AT)
                .is_some_and(|flags| flags & ENCODED == 0)
            && out
                .channel
                .is_some_and(|channel| self.packable.contains(&channel))
    }

    /// A message to be encoded now: its channel, itself, and whether it must be understood alone.
    pub(crate) fn take_to_pack(&mut self) -> Option<(u32, Bytes, bool)> {
        let (out, taken) = self.packing.as_mut().filter(|(_, taken)| !taken)?;
        *taken = true;
        Some((out.channel?, out.payload.clone(), out.each))
    }

    /// It was encoded; none: it goes as it is.
    pub(crate) fn packed(&mut self, frame: Option<(Bytes, Duration)>) {
        let Some((mut out, _)) = self.packing.take() else {
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
                    self.packable.remove(&channel);
                }
            }
        }
        self.packed = Some(out);
    }

    /// Whether the socket has all there is for it.
    pub(crate) fn is_idle(&self) -> bool {
        self.urgent.is_empty()
            && self.sending.is_empty()
            && self.packed.is_none()
            && (self.turns.is_empty() || self.packing.is_some())
    }

    /// Forgets what waits on a channel.
    pub(crate) fn forget(&mut self, channel: u32) {
        let waiting = self.topics.remove(&channel).unwrap_or_default();
        for _ in waiting {
            count(&mut self.dropped, channel, Cause::Gone);
        }
        self.packable.remove(&channel);
        if self
            .packed
            .as_ref()
            .is_some_and(|out| out.channel == Some(channel))
        {
            self.packed = None;
            count(&mut self.dropped, channel, Cause::Gone);
        }
        self.turns.retain(|turn| *turn != channel);
    }

    /// Whether anything waits.
    pub(crate) fn is_empty(&self) -> bool {
        self.urgent.is_empty()
            && self.turns.is_empty()
            && self.sending.is_empty()
            && self.packing.is_none()
            && self.packed.is_none()
    }

    /// The next frame.
    pub(crate) fn next(&mut self, now: i64) -> Option<Frame> {
        if let Some(out) = self.urgent.pop_front() {
            self.urgent_bytes -= out.len();
            return Some(self.start(out, now));
        }
        if let Some(out) = self.packed.take() {
            if out.len() <= SMALL {
                self.turn_after(&out);
            }
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
        let busy = self.packing.is_some();
        let ready = |channel: &u32| {
            let first = self.topics.get(channel).and_then(VecDeque::front);
            !busy || first.is_none_or(|first| !self.to_be_packed(first))
        };
        let at = self.turns.iter().position(ready)?;
        let channel = self.turns.remove(at)?;
        let topic = self.topics.get_mut(&channel)?;
        let stale =
            |first: &Out| !first.each && self.max_age.is_some_and(|age| now - first.born > age);
        while topic.len() > 1 && topic.front().is_some_and(stale) {
            topic.pop_front();
            count(&mut self.dropped, channel, Cause::Stale);
        }
        let out = topic.pop_front()?;
        if self.to_be_packed(&out) {
            if !busy {
                self.packing = Some((out, false));
            } else if let Some(topic) = self.topics.get_mut(&channel) {
                // The one before it had grown too old.
                topic.push_front(out);
                self.turns.push_back(channel);
            }
            return None;
        }
        // After a big one the topic waits until that is through.
        if out.len() <= SMALL {
            self.turn_after(&out);
        }
        Some(out)
    }

    /// The topic of a message that has left has its next turn.
    fn turn_after(&mut self, out: &Out) {
        let waiting = out.channel.filter(|channel| {
            let topic = self.topics.get(channel);
            topic.is_some_and(|topic| !topic.is_empty())
        });
        self.turns.extend(waiting);
    }

    fn start(&mut self, mut out: Out, now: i64) -> Frame {
        if out.channel.is_some() && !out.closes {
            out.head[LEFT_AT..LEFT_AT + 8].copy_from_slice(&now.to_le_bytes());
        }
        let length = out.len();
        let again = self.is_sent_again(&out);
        let number = if again || self.kept.len() < MAX_URGENT {
            self.next_number += 1;
            self.next_number - 1
        } else {
            0
        };
        if length <= SMALL {
            self.sent += length as u64;
            let record = out.piece(0, length);
            self.keep(number, again, out);
            return Frame::Whole { number, record };
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

    fn is_sent_again(&self, out: &Out) -> bool {
        let room = self.kept.len() < KEPT.0 && self.kept_bytes + out.held() <= KEPT.1;
        let wanted = if out.is_big() {
            out.each && self.kept.len() < KEPT.0 && budget::has_room(self.kept_big, out)
        } else {
            room
        };
        out.channel.is_none() || out.closes || wanted
    }

    /// Where its bytes are counted while it is kept.
    fn bytes_kept(&mut self, out: &Out) -> &mut usize {
        if out.channel.is_some() && out.is_big() {
            &mut self.kept_big
        } else {
            &mut self.kept_bytes
        }
    }

    fn keep(&mut self, number: u64, again: bool, out: Out) {
        if number == 0 {
            return;
        }
        let kept = match out.channel {
            Some(channel) if !again => Kept::Not(channel),
            channel => {
                *self.bytes_kept(&out) += out.held();
                self.kept_urgent += usize::from(channel.is_none());
                Kept::Again(out)
            }
        };
        let at = self.kept.partition_point(|(kept, _)| *kept < number);
        self.kept.insert(at, (number, kept));
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
            self.keep(sending.number, sending.again, sending.out);
        }
        Some(Frame::More { stream, bytes })
    }

    /// The peer has all numbers up to this one.
    pub(crate) fn acknowledge(&mut self, number: u64) {
        while self.kept.front().is_some_and(|(kept, _)| *kept <= number) {
            if let Some((_, Kept::Again(out))) = self.kept.pop_front() {
                *self.bytes_kept(&out) -= out.held();
                self.kept_urgent -= usize::from(out.channel.is_none());
                // All that went before it has come, too.
                if let Some(channel) = out.channel.filter(|_| out.closes) {
                    self.topics.remove(&channel);
                    self.packable.remove(&channel);
                    self.closed.push(channel);
                }
            }
        }
        self.count_less();
    }

    /// A message came and could not be decoded: where each one counts it goes once more, unless a newer one of a
    /// latched topic has gone. Says whether it does.
    pub(crate) fn again(&mut self, channel: u32, born: i64) -> bool {
        let mut kept = self.kept.iter_mut().rev();
        let damaged = kept.find_map(|(_, kept)| match kept {
            Kept::Again(out) if out.channel == Some(channel) => Some(out),
            _ => None,
        });
        let Some(out) = damaged.filter(|out| out.born == born) else {
            return false;
        };
        let Some(payload) = out.plain.take() else {
            return false;
        };
        let mut head = out.head.clone();
        head[FLAGS_AT] &= !ENCODED;
        let again = Out {
            head,
            payload,
            plain: None,
            ..*out
        };
        self.topics.entry(channel).or_default().push_front(again);
        if !self.turns.contains(&channel) && !self.is_under_way(channel) {
            self.turns.push_back(channel);
        }
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
        let packing = self.packing.take().map(|(out, _)| out);
        for out in packing.into_iter().chain(self.packed.take()) {
            if let Some(channel) = out.channel {
                let topic = self.topics.entry(channel).or_default();
                if out.each || topic.is_empty() {
                    topic.push_front(out);
                } else {
                    count(&mut self.dropped, channel, Cause::Replaced);
                }
            }
        }
        for sending in std::mem::take(&mut self.sending) {
            self.keep(sending.number, sending.again, sending.out);
        }
        for (number, kept) in std::mem::take(&mut self.kept).into_iter().rev() {
            if number <= received || ahead.contains(&number) {
                continue;
            }
            let out = match kept {
                Kept::Again(out) => out,
                Kept::Not(channel) => {
                    count(&mut self.dropped, channel, Cause::CutOff);
                    continue;
                }
            };
            match out.channel {
                None => {
                    self.urgent_bytes += out.len();
                    self.urgent.push_front(out);
                }
                Some(channel) => self.topics.entry(channel).or_default().push_front(out),
            }
        }
        self.kept_bytes = 0;
        self.kept_urgent = 0;
        self.kept_big = 0;
        self.turns = self
            .topics
            .iter()
            .filter(|(_, topic)| !topic.is_empty())
            .map(|(channel, _)| *channel)
            .collect();
    }
}

fn count(dropped: &mut Dropped, channel: u32, cause: Cause) {
    *dropped.entry((channel, cause)).or_default() += 1;
}

mod budget;
#[cfg(test)]
mod tests;
