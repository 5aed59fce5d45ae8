//! The data lane: one queue per topic in which the newest message wins.

use ros::ring::{Ring, RingItem};

use super::Outgoing;
use super::lanes::RecordLane;
use super::outgoing_record::OutgoingRecord;
use crate::drops::Cause;
use crate::limits::{BIG_WAITING, CHEAP, WAITING};
use crate::record::Record;

impl Outgoing {
    pub(super) fn push_message(&mut self, channel: u32, out: OutgoingRecord) {
        if !self.make_room(channel, out.memory_size()) {
            return;
        }
        let (is_big, each) = (out.is_big(), out.each);
        // A big message is worth sending only while it is the newest.
        let limit = if is_big { BIG_WAITING } else { WAITING };
        let topic = self.topics.entry(channel).or_default();
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
        self.topics.entry(channel).or_default().append(last);
        self.turns.enqueue(channel);
    }

    /// Drops everything queued on a channel.
    pub(crate) fn forget_channel(&mut self, channel: u32) {
        let waiting = self.topics.remove(&channel).map_or(0, |topic| topic.len());
        let encoded = self.encoding.forget(channel);
        self.dropped.add(channel, Cause::Gone, waiting as u64 + u64::from(encoded));
        self.turns.withdraw(channel);
        self.openings.remove(&channel);
    }

    /// Returns the next message: the one that was encoded, or the next in turn.
    pub(super) fn next_data(&mut self, now: i64) -> Option<OutgoingRecord> {
        if self.encoding.encoded_message().is_some_and(|out| self.allows(out)) {
            return self.encoding.take_message();
        }
        self.next_message(now)
    }

    /// Returns whether the next message of a topic may be sent or encoded. One message is encoded at a time; the others
    /// wait for it.
    fn has_message_ready(&self, channel: u32) -> bool {
        let waits = |first: &OutgoingRecord| {
            let encoding = self.encoding.message();
            encoding.is_some_and(|other| other.channel == first.channel || self.encoding.should_encode(first))
        };
        let first = self.topics.get(&channel).and_then(Ring::front);
        first.is_none_or(|first| self.allows(first) && !waits(first))
    }

    /// Returns the next message in turn, dropping those that are too old.
    fn next_message(&mut self, now: i64) -> Option<OutgoingRecord> {
        let mut turns = std::mem::take(&mut self.turns);
        let channel = turns.take(|channel| self.has_message_ready(*channel));
        self.turns = turns;
        let channel = channel?;
        let topic = self.topics.get_mut(&channel)?;
        let has_expired = |born: i64| self.max_age.is_some_and(|age| now - born > age);
        let is_stale = |first: &OutgoingRecord| !first.each && first.len() > CHEAP && has_expired(first.born);
        let stale = topic.trim(|topic| {
            let stale = topic.len() > 1 && topic.front().is_some_and(is_stale);
            stale.then_some(0)
        });
        self.dropped.add(channel, Cause::Stale, stale.messages);
        let out = topic.pop()?;
        let next = if !self.encoding.should_encode(&out) {
            Some(out)
        } else if self.encoding.message().is_none() {
            self.encoding.begin(out);
            None
        } else {
            // The message before it had become too old.
            topic.put_back(out);
            None
        };
        if !topic.is_empty() {
            self.turns.enqueue(channel);
        }
        next
    }
}
