//! The data lane: one queue per topic in which the newest message wins.

use std::collections::BTreeMap;

use ros::ring::{Ring, RingItem};

use super::Outgoing;
use super::gate::Gate;
use super::lanes::RecordLane;
use super::out::OutgoingRecord;
use crate::drops::Cause;
use crate::limits::{BIG_WAITING, WAITING};
use crate::record::Record;

impl Outgoing {
    pub(super) fn push_message(&mut self, channel: u32, out: OutgoingRecord) {
        if !self.make_room(channel, out.memory_size()) {
            return;
        }
        let (is_big, each) = (out.is_big(), out.each);
        // A big message is worth sending only while it is the newest.
        let limit = if is_big { BIG_WAITING } else { WAITING };
        let topic = topic_queue(&mut self.topics, channel);
        topic.append(out);
        let replaced = topic.trim(|topic| {
            let may = |out: &OutgoingRecord| !out.each || topic.len() > WAITING.messages;
            let mut older = topic.iter().take(topic.len() - 1);
            topic.exceeds(limit).then(|| older.position(may))?
        });
        self.dropped.add(channel, Cause::Replaced, replaced.messages);
        self.turns.enqueue(channel);
        if each {
            self.enforce_budget(channel);
        }
    }

    /// Queues the record that closes a channel, after everything queued on the channel.
    pub(crate) fn close_channel(&mut self, channel: u32, record: &Record) {
        let last = OutgoingRecord {
            channel: Some(channel),
            closes: true,
            each: true,
            ..self.assign_order(OutgoingRecord::new(record, RecordLane::Data))
        };
        topic_queue(&mut self.topics, channel).append(last);
        self.turns.enqueue(channel);
    }

    /// Drops everything queued on a channel.
    pub(crate) fn forget_channel(&mut self, channel: u32) {
        let waiting = self.topics.remove(&channel).map_or(0, |topic| topic.len());
        let encoded = self.encoding.forget(channel);
        self.dropped.add(channel, Cause::Gone, waiting as u64 + u64::from(encoded));
        self.turns.forget(channel);
        self.openings.remove(&channel);
    }

    /// Returns the next message: the one that was encoded, or the next in turn.
    pub(super) fn next_data(&mut self, now: i64) -> Option<OutgoingRecord> {
        let gate = Gate::new(&self.sending, &self.lanes, &self.openings, self.peer);
        let encoded = self.encoding.take_encoded(|out| gate.allows(out));
        encoded.or_else(|| self.next_message(now))
    }

    /// Returns the next message in turn, dropping those that are too old.
    fn next_message(&mut self, now: i64) -> Option<OutgoingRecord> {
        // One message is encoded at a time; the others wait for it.
        let gate = Gate::new(&self.sending, &self.lanes, &self.openings, self.peer);
        let (encoding, topics) = (&mut self.encoding, &mut self.topics);
        let busy = encoding.is_busy() || encoding.has_encoded();
        let channel = self.turns.take(|channel| {
            let first = topics.get(channel).and_then(Ring::front);
            first.is_none_or(|first| gate.allows(first) && !(busy && encoding.should_encode(first)))
        })?;
        let topic = topics.get_mut(&channel)?;
        let is_stale = |first: &OutgoingRecord| !first.each && self.max_age.is_some_and(|age| now - first.born > age);
        let stale = topic.trim(|topic| {
            let stale = topic.len() > 1 && topic.front().is_some_and(is_stale);
            stale.then_some(0)
        });
        self.dropped.add(channel, Cause::Stale, stale.messages);
        let out = topic.pop()?;
        if !encoding.should_encode(&out) {
            return Some(out);
        }
        if busy {
            // The message before it had become too old.
            topic.put_back(out);
            self.turns.enqueue(channel);
        } else {
            encoding.begin(out);
            self.turns.hold(channel);
        }
        None
    }

    /// Gives the topic of a message that has been sent its next turn.
    pub(super) fn end_turn(&mut self, out: &OutgoingRecord) {
        let Some(channel) = out.channel.filter(|_| out.lane == RecordLane::Data) else {
            return;
        };
        match self.topics.get(&channel) {
            None => self.turns.forget(channel),
            Some(topic) => {
                self.turns.release(channel);
                if !topic.is_empty() {
                    self.turns.enqueue(channel);
                }
            }
        }
    }

    /// Sends a message again that was received but could not be decoded, if its topic must not lose messages and no
    /// newer message of a latched topic has been sent. Returns whether it does.
    pub(crate) fn resend_damaged(&mut self, channel: u32, born: i64) -> bool {
        let Some(again) = self.retransmit.take_unencoded(channel, born) else {
            return false;
        };
        topic_queue(&mut self.topics, channel).put_back(again);
        self.turns.enqueue(channel);
        true
    }
}

/// Returns the queue of a channel. Only this module drops messages from it.
pub(super) fn topic_queue(topics: &mut BTreeMap<u32, Ring<OutgoingRecord>>, channel: u32) -> &mut Ring<OutgoingRecord> {
    topics.entry(channel).or_insert_with(Ring::new_unbounded)
}
