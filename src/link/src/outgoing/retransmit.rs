//! The retransmit buffer: what the peer was sent and has not said to have.

use std::collections::{BTreeSet, VecDeque};

use ros::ring::Held;
use ros::turns::Turns;

use super::data::topic;
use super::lanes::Lane;
use super::out::Out;
use super::{Outgoing, Sending, budget};
use crate::drops::Cause;
use crate::limits::KEPT;
use crate::record::{ENCODED, FLAGS_AT};

/// What becomes of a record if the connection is lost.
#[derive(Debug)]
pub(super) enum Sent {
    /// It is sent again.
    Again(Out),
    /// It is not: too much was kept already, or a newer one will come. Of this channel; of none: a line.
    Once(Option<u32>),
}

/// Records by number.
#[derive(Debug, Default)]
pub(super) struct Retransmit {
    records: VecDeque<(u64, Sent)>,
    /// Bytes of messages and lines that are sent again, but for `big`.
    pub(super) bytes: usize,
    /// Bytes of big messages that count one by one.
    pub(super) big: usize,
}

impl Retransmit {
    pub(super) fn len(&self) -> usize {
        self.records.len()
    }

    /// Whether a record that is about to be sent is to be kept in order to be sent again.
    pub(super) fn takes(&self, out: &Out) -> bool {
        // Lines leave room for messages.
        let share = if out.lane == Lane::Lines { 4 } else { 1 };
        let few = self.len() < KEPT.messages / share;
        let wanted = if out.is_big() {
            out.each && few && budget::has_room(self.big, out)
        } else {
            few && self.bytes + out.held() <= KEPT.bytes / share
        };
        out.must_come() || wanted
    }

    /// A record was sent under this number (0: none); `again`: as [`takes`](Self::takes) said.
    pub(super) fn add(&mut self, number: u64, again: bool, out: Out) {
        if number == 0 {
            return;
        }
        let sent = if again {
            self.count(&out, |counter| counter + out.held());
            Sent::Again(out)
        } else {
            Sent::Once(out.channel)
        };
        let at = self.records.partition_point(|(kept, _)| *kept < number);
        self.records.insert(at, (number, sent));
    }

    /// Changes the counter of its bytes; those of other lanes count there.
    fn count(&mut self, out: &Out, change: impl Fn(usize) -> usize) {
        let counter = match out.lane {
            Lane::Data if out.is_big() => &mut self.big,
            Lane::Data | Lane::Lines => &mut self.bytes,
            _ => return,
        };
        *counter = change(*counter);
    }

    /// Lets go of the next record that would have been sent again, of those that the peer has: all up to this number.
    pub(super) fn acknowledged(&mut self, number: u64) -> Option<Out> {
        while self
            .records
            .front()
            .is_some_and(|(kept, _)| *kept <= number)
        {
            if let Some((_, Sent::Again(out))) = self.records.pop_front() {
                self.count(&out, |counter| counter - out.held());
                return Some(out);
            }
        }
        None
    }

    /// The message of this channel that was born then, as it was before it was encoded: unless it is not the last one
    /// of its channel, or was given out before.
    pub(super) fn damaged(&mut self, channel: u32, born: i64) -> Option<Out> {
        let of_channel =
            |sent: &Sent| matches!(sent, Sent::Again(out) if out.channel == Some(channel));
        let at = self
            .records
            .iter()
            .rposition(|(_, sent)| of_channel(sent))?;
        let (number, sent) = self.records.remove(at)?;
        let Sent::Again(mut out) = sent else {
            return None;
        };
        // What is kept is smaller without it, and may be counted elsewhere then.
        self.count(&out, |counter| counter - out.held());
        let plain = if out.born == born {
            out.plain.take()
        } else {
            None
        };
        let mut again = out.clone();
        self.count(&out, |counter| counter + out.held());
        self.records.insert(at, (number, Sent::Again(out)));
        again.payload = plain?;
        again.head[FLAGS_AT] &= !ENCODED;
        Some(again)
    }

    /// All records, by number.
    pub(super) fn into_records(self) -> impl DoubleEndedIterator<Item = (u64, Sent)> {
        self.records.into_iter()
    }
}

impl Outgoing {
    /// The peer has all numbers up to this one.
    pub(crate) fn acknowledge(&mut self, number: u64) {
        let number = number.min(self.next_number - 1);
        self.acknowledged = self.acknowledged.max(number);
        while let Some(out) = self.retransmit.acknowledged(number) {
            self.has_come(&out);
        }
        self.count_less();
    }

    fn has_come(&mut self, out: &Out) {
        self.lanes.let_go(out);
        // All that went before it has come, too.
        if let Some(channel) = out.channel.filter(|_| out.closes) {
            self.topics.remove(&channel);
            self.turns.forget(channel);
            self.openings.remove(&channel);
            self.encoding.remove(channel);
            self.closed.push(channel);
        }
    }

    fn was_lost(&mut self, channel: Option<u32>) {
        match channel {
            Some(channel) => self.dropped.add(channel, Cause::CutOff, 1),
            None => self.lines.leave_out(1),
        }
    }

    /// A new connection, the peer having all up to `received` and those `ahead`: the rest of what was kept goes first,
    /// in order. Big messages that were under way are lost unless each one counts.
    pub(crate) fn reconnect(&mut self, received: u64, ahead: &[u64]) {
        for out in self.encoding.give_up() {
            if let Some(channel) = out.channel {
                let topic = topic(&mut self.topics, channel);
                if out.each || topic.is_empty() {
                    topic.put_back(out);
                } else {
                    self.dropped.add(channel, Cause::Replaced, 1);
                }
            }
        }
        for Sending {
            number, again, out, ..
        } in std::mem::take(&mut self.sending)
        {
            if number == 0 {
                self.was_lost(out.channel);
            }
            self.retransmit.add(number, again, out);
        }
        let ahead: BTreeSet<u64> = ahead.iter().copied().collect();
        for (number, sent) in std::mem::take(&mut self.retransmit).into_records().rev() {
            match sent {
                Sent::Again(out) if number <= received || ahead.contains(&number) => {
                    self.has_come(&out);
                }
                Sent::Again(out) => match (out.lane, out.channel) {
                    (Lane::Lines, _) => self.lines.put_back(out),
                    (Lane::Data, Some(channel)) => topic(&mut self.topics, channel).put_back(out),
                    _ => self.lanes.put_back(out),
                },
                Sent::Once(_) if number <= received || ahead.contains(&number) => {}
                Sent::Once(channel) => self.was_lost(channel),
            }
        }
        self.acknowledged = self.next_number - 1;
        self.turns = Turns::default();
        let waiting = self.topics.iter().filter(|(_, topic)| !topic.is_empty());
        waiting.for_each(|(channel, _)| self.turns.join(*channel));
    }
}
