//! The retransmit buffer: records that were sent and not yet acknowledged.

use std::collections::{BTreeSet, VecDeque};

use ros::ring::RingItem;
use ros::turns::RoundRobin;

use super::data::topic_queue;
use super::lanes::RecordLane;
use super::out::{InFlightRecord, OutgoingRecord};
use super::{Outgoing, budget};
use crate::drops::Cause;
use crate::limits::KEPT;
use crate::record::{ENCODED, FLAGS_AT};

/// A sent record, by its fate if the connection is lost.
#[derive(Debug)]
pub(super) enum SentRecord {
    /// It is sent again.
    Again(OutgoingRecord),
    /// It is not sent again, because the buffer was full or a newer one will follow. Contains the channel; `None` for a
    /// line.
    Once(Option<u32>),
}

/// The records by number.
#[derive(Debug, Default)]
pub(super) struct RetransmitBuffer {
    records: VecDeque<(u64, SentRecord)>,
    /// Bytes of messages and lines that are sent again, excluding `big`.
    pub(super) bytes: usize,
    /// Bytes of big messages that must be delivered.
    pub(super) big: usize,
}

impl RetransmitBuffer {
    pub(super) fn len(&self) -> usize {
        self.records.len()
    }

    /// Returns whether a record that is about to be sent is to be kept for retransmission.
    pub(super) fn should_keep(&self, out: &OutgoingRecord) -> bool {
        // Lines leave room for messages.
        let share = if out.lane == RecordLane::Lines { 4 } else { 1 };
        let few = self.len() < KEPT.messages / share;
        let wanted = if out.is_big() {
            out.each && few && budget::has_room(self.big, out)
        } else {
            few && self.bytes + out.memory_size() <= KEPT.bytes / share
        };
        out.is_required() || wanted
    }

    /// Adds a record that was sent under this number (0: unnumbered). `again` is the result of
    /// [`should_keep`](Self::should_keep).
    pub(super) fn add(&mut self, number: u64, again: bool, out: OutgoingRecord) {
        if number == 0 {
            return;
        }
        let sent = if again {
            self.update_counter(&out, |counter| counter + out.memory_size());
            SentRecord::Again(out)
        } else {
            SentRecord::Once(out.channel)
        };
        let at = self.records.partition_point(|(kept, _)| *kept < number);
        self.records.insert(at, (number, sent));
    }

    /// Updates the byte counter of a record; those of other lanes are counted there.
    fn update_counter(&mut self, out: &OutgoingRecord, change: impl Fn(usize) -> usize) {
        let counter = match out.lane {
            RecordLane::Data if out.is_big() => &mut self.big,
            RecordLane::Data | RecordLane::Lines => &mut self.bytes,
            _ => return,
        };
        *counter = change(*counter);
    }

    /// Removes the next record kept for retransmission, among those acknowledged by this number.
    pub(super) fn pop_acknowledged(&mut self, number: u64) -> Option<OutgoingRecord> {
        while self.records.front().is_some_and(|(kept, _)| *kept <= number) {
            if let Some((_, SentRecord::Again(out))) = self.records.pop_front() {
                self.update_counter(&out, |counter| counter - out.memory_size());
                return Some(out);
            }
        }
        None
    }

    /// Returns the message of this channel with this creation time in its unencoded form, unless it is not the last
    /// message of its channel or was returned before.
    pub(super) fn take_unencoded(&mut self, channel: u32, born: i64) -> Option<OutgoingRecord> {
        let of_channel = |sent: &SentRecord| matches!(sent, SentRecord::Again(out) if out.channel == Some(channel));
        let at = self.records.iter().rposition(|(_, sent)| of_channel(sent))?;
        let (number, sent) = self.records.remove(at)?;
        let SentRecord::Again(mut out) = sent else {
            return None;
        };
        // Without the unencoded form the record is smaller and may be counted elsewhere.
        self.update_counter(&out, |counter| counter - out.memory_size());
        let plain = if out.born == born { out.plain.take() } else { None };
        let mut again = out.clone();
        self.update_counter(&out, |counter| counter + out.memory_size());
        self.records.insert(at, (number, SentRecord::Again(out)));
        again.payload = plain?;
        again.head[FLAGS_AT] &= !ENCODED;
        Some(again)
    }

    /// Returns all records by number.
    pub(super) fn into_records(self) -> impl DoubleEndedIterator<Item = (u64, SentRecord)> {
        self.records.into_iter()
    }
}

impl Outgoing {
    /// Handles an acknowledgement of all numbers up to this one.
    pub(crate) fn acknowledge(&mut self, number: u64) {
        let number = number.min(self.next_number - 1);
        self.acknowledged = self.acknowledged.max(number);
        while let Some(out) = self.retransmit.pop_acknowledged(number) {
            self.on_delivered(&out);
        }
        self.release_unused();
    }

    fn on_delivered(&mut self, out: &OutgoingRecord) {
        self.lanes.release(out);
        // Everything sent before it has been delivered, too.
        if let Some(channel) = out.channel.filter(|_| out.closes) {
            self.topics.remove(&channel);
            self.turns.forget(channel);
            self.openings.remove(&channel);
            self.encoding.remove(channel);
            self.closed.push(channel);
        }
    }

    fn on_lost(&mut self, channel: Option<u32>) {
        match channel {
            Some(channel) => self.dropped.add(channel, Cause::CutOff, 1),
            None => self.lines.note_omitted(1),
        }
    }

    /// Begins a new connection. The peer has received everything up to `received` and the numbers in `ahead`; the other
    /// kept records are sent first, in order. Big messages that were in flight are lost unless they must be delivered.
    pub(crate) fn reconnect(&mut self, received: u64, ahead: &[u64]) {
        for out in self.encoding.drain() {
            if let Some(channel) = out.channel {
                let topic = topic_queue(&mut self.topics, channel);
                if out.each || topic.is_empty() {
                    topic.put_back(out);
                } else {
                    self.dropped.add(channel, Cause::Replaced, 1);
                }
            }
        }
        for InFlightRecord { number, again, out, .. } in std::mem::take(&mut self.sending) {
            if number == 0 {
                self.on_lost(out.channel);
            }
            self.retransmit.add(number, again, out);
        }
        let ahead: BTreeSet<u64> = ahead.iter().copied().collect();
        for (number, sent) in std::mem::take(&mut self.retransmit).into_records().rev() {
            match sent {
                SentRecord::Again(out) if number <= received || ahead.contains(&number) => {
                    self.on_delivered(&out);
                }
                SentRecord::Again(out) => match (out.lane, out.channel) {
                    (RecordLane::Lines, _) => self.lines.put_back(out),
                    (RecordLane::Data, Some(channel)) => topic_queue(&mut self.topics, channel).put_back(out),
                    _ => self.lanes.put_back(out),
                },
                SentRecord::Once(_) if number <= received || ahead.contains(&number) => {}
                SentRecord::Once(channel) => self.on_lost(channel),
            }
        }
        self.acknowledged = self.next_number - 1;
        self.turns = RoundRobin::default();
        let waiting = self.topics.iter().filter(|(_, topic)| !topic.is_empty());
        waiting.for_each(|(channel, _)| self.turns.enqueue(*channel));
    }
}
