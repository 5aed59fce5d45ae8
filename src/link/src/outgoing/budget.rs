//! Limits the bytes that wait for the peer: of messages that must all arrive (latched messages, messages of actions), which are
//! within the limit not dropped in favour of newer ones; and of everything, in the budget of the session's owner.

use ::budget::{Exceeded, UNCOUNTED};
use ros::ring::{Held, Ring};

use super::lanes::Lane;
use super::{Out, Outgoing};
use crate::drops::Cause;
use crate::limits::EACH;

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
        // Of other lanes it counts there until the peer has it.
        let sending = sending.filter(|out| out.lane == Lane::Data);
        let under_way: usize = sending
            .chain(self.encoding.messages())
            .map(Held::held)
            .sum();
        let waiting = self.lanes.bytes() + self.lines.bytes() + topics;
        waiting + under_way + self.retransmit.bytes + self.retransmit.big
    }

    /// Counts `bytes` more. The sum is made only when enough has come together.
    pub(super) fn count_more(&mut self, bytes: usize) -> Result<(), Exceeded> {
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
            // One that is followed by newer ones goes first.
            let others = topics
                .iter()
                .filter(|(of, (count, _))| *of != channel || *count > 1);
            let biggest =
                others.max_by_key(|(_, (count, bytes))| (*count > 1 && *bytes > LITTLE, *bytes));
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
