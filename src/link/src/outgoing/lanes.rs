//! The lanes of records that must come, and that of lines.

use ros::ring::{Bounds, Held, Ring};

use super::out::Out;
use crate::control::FromCloud;
use crate::limits::{ANSWERS, CALLS, CONTROL, LINES};
use crate::record::Record;

/// Where a record waits. One record of a lane is under way at a time, of data one of each topic, so none overtakes another of its lane.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Lane {
    /// What the ends tell each other.
    Control,
    /// Calls, goals, and what cancels them.
    Calls,
    /// Answers that go in one piece: whose they are stands in them, so they need not wait for long ones.
    Answers,
    /// Answers in several pieces.
    LongAnswers,
    /// Messages of topics.
    Data,
    /// Lines that a node has printed.
    Lines,
}

/// A line is sent beside other records when so many times its bytes of those have gone.
const LINES_SHARE: usize = 16;
/// Bytes of lines that may follow each other after a time without any.
const MOST_CREDIT: usize = 16 << 10;

/// Records that wait, are under way or are kept until the peer has them.
#[derive(Debug, Clone, Copy, Default)]
struct Load {
    records: usize,
    bytes: usize,
}

/// The lanes of control, of calls and goals, and of answers.
#[derive(Debug)]
pub(super) struct Lanes {
    waiting: [Ring<Out>; 4],
    loads: [Load; 4],
}

impl Default for Lanes {
    fn default() -> Self {
        Self {
            waiting: std::array::from_fn(|_| Ring::unbounded()),
            loads: Default::default(),
        }
    }
}

impl Lanes {
    /// What of these is kept, and how much of it at most: both lanes of answers together.
    fn load(&self, lane: Lane) -> (Load, &'static str, Bounds) {
        let [control, calls, short, long] = self.loads;
        match lane {
            Lane::Control => (control, "orders", CONTROL),
            Lane::Calls => (calls, "calls", CALLS),
            _ => {
                let both = Load {
                    records: short.records + long.records,
                    bytes: short.bytes + long.bytes,
                };
                (both, "answers", ANSWERS)
            }
        }
    }

    /// Why no more records of a lane may be kept beside those that are, if this one has so many bytes.
    pub(super) fn refuse(&self, lane: Lane, bytes: usize) -> Option<String> {
        let (load, what, bounds) = self.load(lane);
        let is_full = load.records >= bounds.messages
            || (load.records > 0 && load.bytes + bytes > bounds.bytes);
        is_full.then(|| {
            let Load { records, bytes } = load;
            format!("{records} {what} of {bytes} bytes wait for it or are not acknowledged")
        })
    }

    /// Adds a record that is kept from now on.
    pub(super) fn push(&mut self, out: Out) {
        let load = &mut self.loads[out.lane as usize];
        load.records += 1;
        load.bytes += out.held();
        self.waiting[out.lane as usize].append(out);
    }

    /// Adds one that has not come, before the others.
    pub(super) fn put_back(&mut self, out: Out) {
        self.waiting[out.lane as usize].put_back(out);
    }

    /// The peer has this one.
    pub(super) fn let_go(&mut self, out: &Out) {
        if let Some(load) = self.loads.get_mut(out.lane as usize) {
            load.records -= 1;
            load.bytes -= out.held();
        }
    }

    /// The lane of the record that was pushed first, of the first ones of all lanes that `may` go.
    pub(super) fn first(&self, may: impl Fn(&Out) -> bool) -> Option<Lane> {
        let firsts = self.waiting.iter().filter_map(Ring::front);
        let first = firsts.filter(|out| may(out)).min_by_key(|out| out.order)?;
        Some(first.lane)
    }

    pub(super) fn take(&mut self, lane: Lane) -> Option<Out> {
        self.waiting[lane as usize].pop()
    }

    /// The next order to be told.
    pub(super) fn next_control(&self) -> Option<u64> {
        let first = self.waiting[Lane::Control as usize].front();
        first.map(|out| out.order)
    }

    /// Whether a goal of this channel waits.
    pub(super) fn has_goal(&self, channel: u32) -> bool {
        let mut calls = self.waiting[Lane::Calls as usize].iter();
        calls.any(|out| out.channel == Some(channel))
    }

    pub(super) fn is_empty(&self) -> bool {
        self.waiting.iter().all(Ring::is_empty)
    }

    /// Bytes of all that is kept.
    pub(super) fn bytes(&self) -> usize {
        self.loads.iter().map(|load| load.bytes).sum()
    }
}

/// Lines of a node: the oldest are left out where they are too many, and they take a small share of a link on which something else waits.
#[derive(Debug)]
pub(super) struct Lines {
    waiting: Ring<Out>,
    /// Bytes that may go beside what waits.
    credit: usize,
}

impl Default for Lines {
    fn default() -> Self {
        Self {
            waiting: Ring::unbounded(),
            credit: 0,
        }
    }
}

impl Lines {
    pub(super) fn push(&mut self, line: Out) {
        self.waiting.append(line);
        let mut left_out = 0;
        while self.waiting.exceeds(LINES) {
            left_out += self.waiting.pop().map_or(0, |oldest| oldest.lines());
        }
        self.leave_out(left_out);
    }

    /// Adds one that has not come, before the others.
    pub(super) fn put_back(&mut self, line: Out) {
        self.waiting.put_back(line);
    }

    /// Has it told that lines before the others will not come.
    pub(super) fn leave_out(&mut self, lines: i64) {
        if lines > 0 {
            let told = self.waiting.front().is_some_and(|first| first.must_come());
            let told = told.then(|| self.waiting.pop()).flatten();
            let more = told.map_or(0, |told| told.lines());
            self.waiting.put_back(Out::left_out(lines + more));
        }
    }

    /// So many bytes of something else were sent.
    pub(super) fn earn(&mut self, bytes: usize) {
        self.credit = (self.credit + bytes / LINES_SHARE).min(MOST_CREDIT);
    }

    /// The next line, if it `may` go. `is_alone`: nothing else can.
    pub(super) fn take(&mut self, is_alone: bool, may: impl Fn(&Out) -> bool) -> Option<Out> {
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

impl Out {
    /// What is told in place of lines that do not come.
    fn left_out(lines: i64) -> Self {
        let noun = if lines == 1 { "line" } else { "lines" };
        let line = FromCloud::Line {
            error: true,
            text: format!(
                "[{lines} {noun} of the node left out here: it prints more than the link carries; the server has its whole log]"
            ),
        };
        let json = serde_json::to_vec(&line).unwrap_or_default();
        Self {
            each: true,
            born: lines,
            ..Self::of(&Record::Control(json.into()), Lane::Lines)
        }
    }

    /// How many lines of the node it stands for.
    fn lines(&self) -> i64 {
        self.born.max(1)
    }
}
