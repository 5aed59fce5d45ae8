//! The lanes of records that must be delivered, and the lane of printed lines.

use ros::ring::{Ring, RingBounds, RingItem};

use super::outgoing_record::OutgoingRecord;
use crate::control::FromCloud;
use crate::limits::{ANSWERS, CALLS, CONTROL, LAST_LINES, LINES};
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
    /// Lines printed by a node.
    Lines,
    /// Topic messages, which have a queue per topic.
    Data,
}

impl RecordLane {
    /// Returns whether its records may be dropped. Those of other lanes count against a limit while they are queued.
    pub(super) fn is_droppable(self) -> bool {
        matches!(self, Self::Lines | Self::Data)
    }
}

/// Share of lines on a busy link: one byte of lines per this many bytes of other records.
const LINES_SHARE: usize = 16;
/// Maximum burst of lines in bytes after a time without any.
const MOST_CREDIT: usize = 16 << 10;

/// Records that are queued, in flight or unacknowledged; of the lanes of lines and messages, those that are sent again
/// unless they are acknowledged.
#[derive(Debug, Clone, Copy, Default)]
struct LaneLoad {
    records: usize,
    bytes: usize,
}

/// The lanes of control messages, of calls and goals, and of responses, whose records must be delivered; and that of
/// lines, of which the oldest are omitted if there are too many, and which get a small share of a busy link.
#[derive(Debug, Default)]
pub(super) struct RecordLanes {
    waiting: [Ring<OutgoingRecord>; 5],
    /// Load of each lane, and of messages in several pieces.
    loads: [LaneLoad; 7],
    /// Bytes of lines that may be sent ahead of other queued records.
    credit: usize,
}

impl RecordLanes {
    /// Returns why another record of this size may not be kept in a lane.
    pub(super) fn overflow_reason(&self, lane: RecordLane, bytes: usize) -> Option<String> {
        let (loads, what, bounds) = match lane {
            RecordLane::Control => (&self.loads[..1], "orders", CONTROL),
            RecordLane::Calls => (&self.loads[1..2], "calls", CALLS),
            // Both lanes of responses count together.
            _ => (&self.loads[2..4], "answers", ANSWERS),
        };
        let records: usize = loads.iter().map(|load| load.records).sum();
        let kept: usize = loads.iter().map(|load| load.bytes).sum();
        let is_full = records >= bounds.messages || (records > 0 && kept + bytes > bounds.bytes);
        is_full.then(|| format!("{records} {what} of {kept} bytes wait for it or are not acknowledged"))
    }

    /// Queues a record; it is kept until it is acknowledged.
    pub(super) fn push(&mut self, out: OutgoingRecord) {
        self.count(&out);
        self.waiting[out.lane as usize].append(out);
    }

    /// Queues a record that was not received, in front of the others.
    pub(super) fn put_back(&mut self, out: OutgoingRecord) {
        self.waiting[out.lane as usize].put_back(out);
    }

    fn load_mut(&mut self, out: &OutgoingRecord) -> &mut LaneLoad {
        let is_big_message = out.lane == RecordLane::Data && out.is_big();
        &mut self.loads[out.lane as usize + usize::from(is_big_message)]
    }

    /// Counts a record until it is [released](Self::release).
    pub(super) fn count(&mut self, out: &OutgoingRecord) {
        let load = self.load_mut(out);
        load.records += 1;
        load.bytes += out.memory_size();
    }

    /// Releases a record that the peer has acknowledged, or that is queued again.
    pub(super) fn release(&mut self, out: &OutgoingRecord) {
        let load = self.load_mut(out);
        load.records -= 1;
        load.bytes -= out.memory_size();
    }

    /// Returns the bytes of lines and small messages, and of big messages, that are not acknowledged.
    pub(super) fn unacknowledged_bytes(&self) -> (usize, usize) {
        let [.., lines, small, big] = self.loads;
        (lines.bytes + small.bytes, big.bytes)
    }

    /// Returns the lane of the oldest record that must be delivered, among the first ones of their lanes that `may` be
    /// sent.
    pub(super) fn first_ready(&self, may: impl Fn(&OutgoingRecord) -> bool) -> Option<RecordLane> {
        let firsts = self.waiting[..RecordLane::Lines as usize].iter().filter_map(Ring::front);
        let first = firsts.filter(|out| may(out)).min_by_key(|out| out.order)?;
        Some(first.lane)
    }

    pub(super) fn take(&mut self, lane: RecordLane) -> Option<OutgoingRecord> {
        self.waiting[lane as usize].pop()
    }

    /// Returns the queued records of a lane.
    pub(super) fn records_of(&self, lane: RecordLane) -> impl Iterator<Item = &OutgoingRecord> {
        self.waiting[lane as usize].iter()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.waiting.iter().all(Ring::is_empty)
    }

    /// Returns the number of bytes kept in all lanes.
    pub(super) fn bytes(&self) -> usize {
        let lines = self.waiting[RecordLane::Lines as usize].bytes();
        lines + self.loads.iter().map(|load| load.bytes).sum::<usize>()
    }

    pub(super) fn push_line(&mut self, line: OutgoingRecord) {
        self.waiting[RecordLane::Lines as usize].append(line);
        self.omit_lines(LINES);
    }

    /// Takes the newest lines; the others are omitted.
    pub(super) fn take_last_lines(&mut self) -> Ring<OutgoingRecord> {
        self.omit_lines(LAST_LINES);
        std::mem::take(&mut self.waiting[RecordLane::Lines as usize])
    }

    /// Omits the oldest lines beyond a limit.
    fn omit_lines(&mut self, limit: RingBounds) {
        let lines = &mut self.waiting[RecordLane::Lines as usize];
        let mut left_out = 0;
        while lines.exceeds(limit) {
            left_out += lines.pop().map_or(0, |oldest| oldest.line_count());
        }
        self.note_omitted_lines(left_out);
    }

    /// Notes that lines in front of the queue are omitted, so that the peer is told.
    pub(super) fn note_omitted_lines(&mut self, count: i64) {
        let lines = &mut self.waiting[RecordLane::Lines as usize];
        if count > 0 {
            let told = lines.front().is_some_and(|first| first.is_required());
            let told = told.then(|| lines.pop()).flatten();
            let more = told.map_or(0, |told| told.line_count());
            lines.put_back(OutgoingRecord::omission_notice(count + more));
        }
    }

    /// Credits lines with their share of other bytes sent.
    pub(super) fn earn_credit(&mut self, bytes: usize) {
        self.credit = (self.credit + bytes / LINES_SHARE).min(MOST_CREDIT);
    }

    /// Takes the next line, if its share allows that. `is_alone`: nothing else can be sent.
    pub(super) fn take_line(&mut self, is_alone: bool) -> Option<OutgoingRecord> {
        let length = self.records_of(RecordLane::Lines).next()?.len().min(MOST_CREDIT);
        if !is_alone && length > self.credit {
            return None;
        }
        self.credit = self.credit.saturating_sub(length);
        self.take(RecordLane::Lines)
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
