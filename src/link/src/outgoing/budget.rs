//! Limits the bytes that wait for the peer: of messages that must all arrive (latched messages, messages of actions), which are
//! within the limit not dropped in favour of newer ones; of urgent records; and of everything, in the budget of the session's
//! owner.

use ::budget::{Exceeded, UNCOUNTED};
use ros::ring::{Held, Ring};

use super::{MAX_URGENT, MAX_URGENT_BYTES, Out, Outgoing};
use crate::drops::Cause;

/// Bytes of such messages that may wait, over all topics, beside the last one; and that are kept until they are acknowledged.
pub(super) const EACH: usize = 64 << 20;
/// Bytes below which a topic's messages are not dropped, as long as another topic has more than its last message.
const LITTLE: usize = 1 << 20;

/// Whether a message may be kept beside so many bytes of others; a single message may have any size.
pub(super) fn has_room(kept: usize, out: &Out) -> bool {
    kept == 0 || kept + out.held() <= EACH
}

/// How many of them wait on a topic, and their bytes.
fn load(waiting: &Ring<Out>) -> (usize, usize) {
    let all = waiting.iter().filter(|out| out.counts());
    all.fold((0, 0), |(count, bytes), out| {
        (count + 1, bytes + out.held())
    })
}

impl Out {
    /// It is a message that no newer one replaces.
    fn counts(&self) -> bool {
        self.each && !self.closes
    }
}

impl Outgoing {
    /// Whether an urgent record of `bytes` bytes may be queued beside those that wait, are under way and are kept until the peer
    /// has them. If not, the session is given up: to leave one out would be to lose a call or its answer.
    pub(super) fn takes_urgent(&mut self, bytes: usize) -> bool {
        if self.full.is_some() {
            return false;
        }
        let sending = self.sending.iter().filter(|one| one.out.channel.is_none());
        let (started, started_bytes) = sending.fold((0, 0), |(count, sum), one| {
            (count + 1, sum + one.out.held())
        });
        let count = self.urgent.len() + self.retransmit.urgent + started;
        let sum = self.urgent.bytes() + self.retransmit.bytes + started_bytes;
        let too_much = count >= MAX_URGENT || (count > 0 && sum + bytes > MAX_URGENT_BYTES);
        self.full = match self.count_more(bytes) {
            _ if too_much => Some(format!(
                "{count} records of {sum} bytes wait for it or are not acknowledged"
            )),
            Ok(()) => None,
            Err(full) => Some(full.to_string()),
        };
        self.full.is_none()
    }

    /// Whether a message of `bytes` bytes may be queued. Where there is no room it takes the place of older ones of its topic;
    /// without any it is dropped.
    pub(super) fn takes_message(&mut self, channel: u32, bytes: usize) -> bool {
        loop {
            if self.count_more(bytes).is_ok() {
                return true;
            }
            let waiting = self.topics.get_mut(&channel).filter(|all| all.len() > 1);
            let replaced = waiting.and_then(|waiting| {
                let at = waiting.iter().position(|out| !out.each)?;
                waiting.remove(at)
            });
            if replaced.is_none() {
                self.dropped.add(channel, Cause::Full, 1);
                return false;
            }
            self.dropped.add(channel, Cause::Replaced, 1);
        }
    }

    /// Bytes that wait, are under way, and are kept.
    fn held(&self) -> usize {
        let topics: usize = self.topics.values().map(Ring::bytes).sum();
        let sending = self.sending.iter().map(|sending| &sending.out);
        let under_way = sending.chain(self.encoding.messages());
        let under_way: usize = under_way.map(Held::held).sum();
        self.urgent.bytes() + topics + under_way + self.retransmit.bytes + self.retransmit.big
    }

    /// Counts `bytes` more. The sum is made only when enough has come together.
    fn count_more(&mut self, bytes: usize) -> Result<(), Exceeded> {
        let uncounted = self.uncounted + bytes;
        if uncounted > UNCOUNTED {
            self.permit.count(self.held() + bytes)?;
            self.uncounted = 0;
        } else {
            self.uncounted = uncounted;
        }
        Ok(())
    }

    /// Gives back what is held no more.
    pub(super) fn count_less(&mut self) {
        if self.permit.bytes() > 0 {
            // Less always fits.
            let _ = self.permit.count(self.held().min(self.permit.bytes()));
        }
    }

    /// Drops messages until the limit is kept, after one of `channel` was added: first messages that newer ones follow, then
    /// any, each time of the topic with the most bytes. The newest message stays.
    pub(super) fn keep_to_budget(&mut self, channel: u32) {
        loop {
            let topics = self.topics.iter().map(|(of, waiting)| (*of, load(waiting)));
            let topics: Vec<(u32, (usize, usize))> = topics.collect();
            let all: usize = topics.iter().map(|(_, (_, bytes))| bytes).sum();
            let last = self.topics.get(&channel).and_then(Ring::back);
            if all - last.map_or(0, Held::held).min(all) <= EACH {
                return;
            }
            let size = |&&(_, (_, bytes)): &&(u32, (usize, usize))| bytes;
            let followed = topics
                .iter()
                .filter(|(_, (count, bytes))| *count > 1 && *bytes > LITTLE);
            let others = topics
                .iter()
                .filter(|(of, (count, _))| *of != channel || *count > 1);
            let biggest = followed.max_by_key(size).or(others.max_by_key(size));
            let Some(&(of, _)) = biggest else { return };
            let Some(waiting) = self.topics.get_mut(&of) else {
                return;
            };
            let oldest = waiting.iter().position(Out::counts);
            if oldest.and_then(|at| waiting.remove(at)).is_none() {
                return;
            }
            if waiting.is_empty() {
                self.turns.withdraw(of);
            }
            self.dropped.add(of, Cause::Full, 1);
        }
    }
}
