//! The lanes of records that must be delivered, and the lane of printed lines.

use ros::ring::{Ring, RingBounds, RingItem};

use super::out::OutgoingRecord;
use crate::control::FromCloud;
use crate::limits::{ANSWERS, CALLS, CONTROL, LINES};
use crate::record::Record;

/// The queue to which a record belongs. One record of each lane (of the data lane: of each topic) is in flight at a
/// time, so that none overtakes another of its lane.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum RecordLane {
    /// Control messages.
    Control,
    /// Calls, goals and their cancellations.
    Calls,
    /// Responses in one piece. They carry the id of their call, so they need not wait for long responses.
    Answers,
    /// Responses in several pieces.
    LongAnswers,
    /// Topic messages.
    Data,
    /// Lines printed by a node.
    Lines,
}

/// Share of lines on a busy link: one byte of lines per this many bytes of other records.
const LINES_SHARE: usize = 16;
/// Maximum burst of lines in bytes after a time without any.
const MOST_CREDIT: usize = 16 << 10;

/// Records that are queued, in flight or unacknowledged.
#[derive(Debug, Clone, Copy, Default)]
struct LaneLoad {
    records: usize,
    bytes: usize,
}

/// The lanes of control messages, of calls and goals, and of responses.
#[derive(Debug)]
pub(super) struct RecordLanes {
    waiting: [Ring<OutgoingRecord>; 4],
    loads: [LaneLoad; 4],
}

impl Default for RecordLanes {
    fn default() -> Self {
        Self { waiting: std::array::from_fn(|_| Ring::new_unbounded()), loads: Default::default() }
    }
}

impl RecordLanes {
    /// Returns the load of a lane, the name of its records and its limit; both lanes of responses count together.
    fn load(&self, lane: RecordLane) -> (LaneLoad, &'static str, RingBounds) {
        let [control, calls, short, long] = self.loads;
        match lane {
            RecordLane::Control => (control, "orders", CONTROL),
            RecordLane::Calls => (calls, "calls", CALLS),
            _ => {
                let both = LaneLoad { records: short.records + long.records, bytes: short.bytes + long.bytes };
                (both, "answers", ANSWERS)
            }
        }
    }

    /// Returns why another record of this size may not be kept in a lane.
    pub(super) fn overflow_reason(&self, lane: RecordLane, bytes: usize) -> Option<String> {
        let (load, what, bounds) = self.load(lane);
        let is_full = load.records >= bounds.messages || (load.records > 0 && load.bytes + bytes > bounds.bytes);
        is_full.then(|| {
            let LaneLoad { records, bytes } = load;
            format!("{records} {what} of {bytes} bytes wait for it or are not acknowledged")
        })
    }

    /// Queues a record; it is kept until it is acknowledged.
    pub(super) fn push(&mut self, out: OutgoingRecord) {
        let load = &mut self.loads[out.lane as usize];
        load.records += 1;
        load.bytes += out.memory_size();
        self.waiting[out.lane as usize].append(out);
    }

    /// Queues a record that was not received, in front of the others.
    pub(super) fn put_back(&mut self, out: OutgoingRecord) {
        self.waiting[out.lane as usize].put_back(out);
    }

    /// Releases a record that the peer has acknowledged.
    pub(super) fn release(&mut self, out: &OutgoingRecord) {
        if let Some(load) = self.loads.get_mut(out.lane as usize) {
            load.records -= 1;
            load.bytes -= out.memory_size();
        }
    }

    /// Returns the lane of the oldest record, among the first ones of all lanes that `may` be sent.
    pub(super) fn first_ready(&self, may: impl Fn(&OutgoingRecord) -> bool) -> Option<RecordLane> {
        let firsts = self.waiting.iter().filter_map(Ring::front);
        let first = firsts.filter(|out| may(out)).min_by_key(|out| out.order)?;
        Some(first.lane)
    }

    pub(super) fn take(&mut self, lane: RecordLane) -> Option<OutgoingRecord> {
        self.waiting[lane as usize].pop()
    }

    /// Returns the order number of the next control record.
    pub(super) fn next_control(&self) -> Option<u64> {
        let first = self.waiting[RecordLane::Control as usize].front();
        first.map(|out| out.order)
    }

    /// Returns whether a goal of this channel is queued.
    pub(super) fn has_goal(&self, channel: u32) -> bool {
        let mut calls = self.waiting[RecordLane::Calls as usize].iter();
        calls.any(|out| out.channel == Some(channel))
    }

    pub(super) fn is_empty(&self) -> bool {
        self.waiting.iter().all(Ring::is_empty)
    }

    /// Returns the number of bytes kept in all lanes.
    pub(super) fn bytes(&self) -> usize {
        self.loads.iter().map(|load| load.bytes).sum()
    }
}

/// The lines printed by a node: the oldest are omitted if there are too many, and they get a small share of a busy
/// link.
#[derive(Debug)]
pub(super) struct LineQueue {
    waiting: Ring<OutgoingRecord>,
    /// Bytes of lines that may be sent ahead of other queued records.
    credit: usize,
}

impl Default for LineQueue {
    fn default() -> Self {
        Self { waiting: Ring::new_unbounded(), credit: 0 }
    }
}

impl LineQueue {
    pub(super) fn push(&mut self, line: OutgoingRecord) {
        self.waiting.append(line);
        let mut left_out = 0;
        while self.waiting.exceeds(LINES) {
            left_out += self.waiting.pop().map_or(0, |oldest| oldest.line_count());
        }
        self.note_omitted(left_out);
    }

    /// Queues a line that was not received, in front of the others.
    pub(super) fn put_back(&mut self, line: OutgoingRecord) {
        self.waiting.put_back(line);
    }

    /// Notes that lines in front of the queue are omitted, so that the peer is told.
    pub(super) fn note_omitted(&mut self, lines: i64) {
        if lines > 0 {
            let told = self.waiting.front().is_some_and(|first| first.is_required());
            let told = told.then(|| self.waiting.pop()).flatten();
            let more = told.map_or(0, |told| told.line_count());
            self.waiting.put_back(OutgoingRecord::omission_notice(lines + more));
        }
    }

    /// Credits lines with their share of other bytes sent.
    pub(super) fn earn_credit(&mut self, bytes: usize) {
        self.credit = (self.credit + bytes / LINES_SHARE).min(MOST_CREDIT);
    }

    /// Takes the next line, if it `may` be sent. `is_alone`: nothing else can be sent.
    pub(super) fn take(&mut self, is_alone: bool, may: impl Fn(&OutgoingRecord) -> bool) -> Option<OutgoingRecord> {
        let first = self.waiting.front().filter(|out| may(out))?;
        let length = first.len().min(MOST_CREDIT);
        if !is_alone && length > self.credit {
            return None;
        }
        self.credit = self.credit.saturating_sub(length);
        self.waiting.pop()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    pub(super) fn bytes(&self) -> usize {
        self.waiting.bytes()
    }
}

impl OutgoingRecord {
    /// Creates the notice that replaces omitted lines.
    fn omission_notice(lines: i64) -> Self {
        let noun = if lines == 1 { "line" } else { "lines" };
        let line = FromCloud::Line {
            error: true,
            text: format!(
                "[{lines} {noun} of the node omitted here: it prints more than the link carries; the server has its \
                    complete log]"
            ),
        };
        let json = serde_json::to_vec(&line).unwrap_or_default();
        Self { each: true, born: lines, ..Self::new(&Record::Control(json.into()), RecordLane::Lines) }
    }

    /// Returns the number of the node's lines that this record stands for.
    fn line_count(&self) -> i64 {
        self.born.max(1)
    }
}
