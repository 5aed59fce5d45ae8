//! The lane of data: a queue for each topic, in which the newest message wins.

use std::collections::BTreeMap;

use ros::ring::{Held, Ring};

use super::Outgoing;
use super::gate::Gate;
use super::lanes::Lane;
use super::out::Out;
use crate::drops::Cause;
use crate::limits::{BIG_WAITING, WAITING};
use crate::record::Record;

impl Outgoing {
    pub(super) fn push_message(&mut self, channel: u32, out: Out) {
        if !self.takes_message(channel, out.held()) {
            return;
        }
        let (is_big, each) = (out.is_big(), out.each);
        // A big message is only ever worth sending while it is the newest.
        let limit = if is_big { BIG_WAITING } else { WAITING };
        let topic = topic(&mut self.topics, channel);
        topic.append(out);
        let replaced = topic.trim(|topic| {
            let may = |out: &Out| !out.each || topic.len() > WAITING.messages;
            let mut older = topic.iter().take(topic.len() - 1);
            topic.exceeds(limit).then(|| older.position(may))?
        });
        self.dropped
            .add(channel, Cause::Replaced, replaced.messages);
        self.turns.join(channel);
        if each {
            self.keep_to_budget(channel);
        }
    }

    /// Ends a channel by this record, after all that waits on it.
    pub(crate) fn close(&mut self, channel: u32, record: &Record) {
        let last = Out {
            channel: Some(channel),
            closes: true,
            each: true,
            ..self.number(Out::of(record, Lane::Data))
        };
        topic(&mut self.topics, channel).append(last);
        self.turns.join(channel);
    }

    /// Forgets what waits on a channel.
    pub(crate) fn forget(&mut self, channel: u32) {
        let waiting = self.topics.remove(&channel).map_or(0, |topic| topic.len());
        let encoded = self.encoding.forget(channel);
        self.dropped
            .add(channel, Cause::Gone, waiting as u64 + u64::from(encoded));
        self.turns.forget(channel);
        self.openings.remove(&channel);
    }

    /// The next message: one that was encoded, or the next in turn.
    pub(super) fn next_data(&mut self, now: i64) -> Option<Out> {
        let gate = Gate::new(&self.sending, &self.lanes, &self.openings, self.peer);
        let encoded = self.encoding.take_done(|out| gate.lets(out));
        encoded.or_else(|| self.next_message(now))
    }

    /// The next message in turn, without those that have become too old.
    fn next_message(&mut self, now: i64) -> Option<Out> {
        // One is encoded at a time; the others wait for it.
        let gate = Gate::new(&self.sending, &self.lanes, &self.openings, self.peer);
        let (encoding, topics) = (&mut self.encoding, &mut self.topics);
        let busy = encoding.is_busy() || encoding.is_done();
        let channel = self.turns.take(|channel| {
            let first = topics.get(channel).and_then(Ring::front);
            first.is_none_or(|first| gate.lets(first) && !(busy && encoding.wants(first)))
        })?;
        let topic = topics.get_mut(&channel)?;
        let is_stale =
            |first: &Out| !first.each && self.max_age.is_some_and(|age| now - first.born > age);
        let stale = topic.trim(|topic| {
            let stale = topic.len() > 1 && topic.front().is_some_and(is_stale);
            stale.then_some(0)
        });
        self.dropped.add(channel, Cause::Stale, stale.messages);
        let out = topic.pop()?;
        if !encoding.wants(&out) {
            return Some(out);
        }
        if busy {
            // The one before it had grown too old.
            topic.put_back(out);
            self.turns.join(channel);
        } else {
            encoding.begin(out);
            self.turns.hold(channel);
        }
        None
    }

    /// The topic of a message that has left has its next turn.
    pub(super) fn turn_after(&mut self, out: &Out) {
        let Some(channel) = out.channel.filter(|_| out.lane == Lane::Data) else {
            return;
        };
        match self.topics.get(&channel) {
            None => self.turns.forget(channel),
            Some(topic) => {
                self.turns.release(channel);
                if !topic.is_empty() {
                    self.turns.join(channel);
                }
            }
        }
    }

    /// A message came and could not be decoded: where each one counts it goes once more, unless a newer one of a
    /// latched topic has gone. Says whether it does.
    pub(crate) fn again(&mut self, channel: u32, born: i64) -> bool {
        let Some(again) = self.retransmit.damaged(channel, born) else {
            return false;
        };
        topic(&mut self.topics, channel).put_back(again);
        self.turns.join(channel);
        true
    }
}

/// What waits on a channel. Only this module drops something of it.
pub(super) fn topic(topics: &mut BTreeMap<u32, Ring<Out>>, channel: u32) -> &mut Ring<Out> {
    topics.entry(channel).or_insert_with(Ring::unbounded)
}
