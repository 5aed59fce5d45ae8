//! Records that were sent and not yet acknowledged.

use std::collections::BTreeSet;

use ros::ring::{Ring, RingItem};
use ros::turns::RoundRobin;

use super::Outgoing;
use super::lanes::RecordLane;
use super::outgoing_record::{InFlightRecord, OutgoingRecord};
use crate::drops::Cause;
use crate::limits::{MAX_EACH_BYTES, RETRANSMIT_BOUNDS};
use crate::record::{ENCODED, FLAGS_AT};

/// A sent record.
#[derive(Debug)]
pub(super) struct SentRecord {
    number: u64,
    /// Channel of a message; `None` for a line.
    channel: Option<u32>,
    /// The record, if it is sent again after a lost connection. It is not if the buffer was full or a newer one will
    /// follow.
    again: Option<OutgoingRecord>,
}

impl Outgoing {
    /// Returns whether a record that is about to be sent is to be kept for retransmission.
    pub(super) fn should_keep(&self, out: &OutgoingRecord) -> bool {
        // Lines leave room for messages.
        let share = if out.lane == RecordLane::Lines { 4 } else { 1 };
        let few = self.retransmit.len() < RETRANSMIT_BOUNDS.messages / share;
        let (small, big) = self.lanes.unacknowledged_bytes();
        let wanted = if out.is_big() {
            // A single message may have any size.
            out.each && few && (big == 0 || big + out.memory_size() <= MAX_EACH_BYTES)
        } else {
            few && small + out.memory_size() <= RETRANSMIT_BOUNDS.bytes / share
        };
        out.is_required() || wanted
    }

    /// Adds a record that was sent under this number (0: unnumbered). `again` is the result of
    /// [`should_keep`](Self::should_keep).
    pub(super) fn note_sent(&mut self, number: u64, again: bool, out: OutgoingRecord) {
        if number == 0 {
            return;
        }
        if again && out.lane.is_droppable() {
            self.lanes.count(&out);
        }
        let sent = SentRecord { number, channel: out.channel, again: again.then_some(out) };
        let at = self.retransmit.partition_point(|kept| kept.number < number);
        self.retransmit.insert(at, sent);
    }

    /// Sends a message again that was received but could not be decoded, if its topic must not lose messages and no
    /// newer message of a latched topic has been sent. Returns whether it does.
    pub(crate) fn resend_damaged(&mut self, channel: u32, born: i64) -> bool {
        let Some(again) = self.take_unencoded(channel, born) else {
            return false;
        };
        self.put_back(again);
        self.turns.enqueue(channel);
        true
    }

    /// Returns the message of this channel with this creation time in its unencoded form, unless it is not the last
    /// message of its channel or was returned before.
    fn take_unencoded(&mut self, channel: u32, born: i64) -> Option<OutgoingRecord> {
        let mut sent = self.retransmit.iter_mut().rev().filter(|sent| sent.channel == Some(channel));
        let last = sent.find_map(|sent| sent.again.as_mut());
        let last = last.filter(|last| last.born == born && last.plain.is_some())?;
        // Without the unencoded form the record is smaller and may be counted elsewhere.
        self.lanes.release(last);
        let plain = last.plain.take();
        self.lanes.count(last);
        let mut again = OutgoingRecord { payload: plain?, ..last.clone() };
        again.head[FLAGS_AT] &= !ENCODED;
        Some(again)
    }

    /// Handles an acknowledgement of all numbers up to this one.
    pub(crate) fn acknowledge(&mut self, number: u64) {
        let number = number.min(self.numbered);
        self.acknowledged = self.acknowledged.max(number);
        while self.retransmit.front().is_some_and(|sent| sent.number <= number) {
            if let Some(out) = self.retransmit.pop_front().and_then(|sent| sent.again) {
                self.on_delivered(&out);
            }
        }
        self.release_unused();
    }

    fn on_delivered(&mut self, out: &OutgoingRecord) {
        self.lanes.release(out);
        // Everything sent before it has been delivered, too.
        if let Some(channel) = out.channel.filter(|_| out.closes) {
            self.topics.remove(&channel);
            self.turns.withdraw(channel);
            self.openings.remove(&channel);
            self.encoding.channels.remove(&channel);
            self.closed.push(channel);
        }
    }

    /// Queues a record in front of the others of its lane.
    pub(super) fn put_back(&mut self, out: OutgoingRecord) {
        match (out.lane, out.channel) {
            (RecordLane::Data, Some(channel)) => self.topics.entry(channel).or_default().put_back(out),
            _ => self.lanes.put_back(out),
        }
    }

    fn on_lost(&mut self, channel: Option<u32>) {
        match channel {
            Some(channel) => self.dropped.add(channel, Cause::CutOff, 1),
            None => self.lanes.note_omitted_lines(1),
        }
    }

    /// Begins a new connection. The peer has received everything up to `received` and the numbers in `ahead`; the other
    /// kept records are sent first, in order. Big messages that were in flight are lost unless they must be delivered.
    pub(crate) fn reconnect(&mut self, received: u64, ahead: &[u64]) {
        let encoding = self.encoding.take_message();
        if let Some((channel, out)) = encoding.and_then(|out| Some((out.channel?, out))) {
            if out.each || self.topics.get(&channel).is_none_or(Ring::is_empty) {
                self.put_back(out);
            } else {
                self.dropped.add(channel, Cause::Replaced, 1);
            }
        }
        for InFlightRecord { number, again, out, .. } in std::mem::take(&mut self.sending) {
            if number == 0 {
                self.on_lost(out.channel);
            }
            self.note_sent(number, again, out);
        }
        let ahead: BTreeSet<u64> = ahead.iter().copied().collect();
        for SentRecord { number, channel, again } in std::mem::take(&mut self.retransmit).into_iter().rev() {
            let is_received = number <= received || ahead.contains(&number);
            match again {
                Some(out) if is_received => self.on_delivered(&out),
                Some(out) => {
                    if out.lane.is_droppable() {
                        self.lanes.release(&out);
                    }
                    self.put_back(out);
                }
                None if is_received => {}
                None => self.on_lost(channel),
            }
        }
        self.acknowledged = self.numbered;
        self.turns = RoundRobin::default();
        let waiting = self.topics.iter().filter(|(_, topic)| !topic.is_empty());
        waiting.for_each(|(channel, _)| self.turns.enqueue(*channel));
    }
}
