//! Limits on the bytes queued for the peer: for messages that must all be delivered (latched messages, messages of
//! actions), which within the limit are not replaced by newer ones; and for everything, in the budget of the session's
//! owner.

use ::budget::{Exceeded, UNCOUNTED};
use ros::ring::{Ring, RingItem};

use super::lanes::RecordLane;
use super::{Outgoing, OutgoingRecord};
use crate::drops::Cause;
use crate::limits::EACH;

/// Number of bytes below which a topic's messages are not dropped while another topic holds more than its last message.
const LITTLE: usize = 1 << 20;

/// Returns whether a message may be kept in addition to `kept` bytes. A single message may have any size.
pub(super) fn has_room(kept: usize, out: &OutgoingRecord) -> bool {
    kept == 0 || kept + out.memory_size() <= EACH
}

/// Returns the number of irreplaceable messages queued on a topic and their total size in bytes.
fn required_load(waiting: &Ring<OutgoingRecord>) -> (usize, usize) {
    let all = waiting.iter().filter(|out| out.is_irreplaceable());
    all.fold((0, 0), |(count, bytes), out| (count + 1, bytes + out.memory_size()))
}

impl OutgoingRecord {
    /// Returns whether it is a message that no newer one may replace.
    fn is_irreplaceable(&self) -> bool {
        self.each && !self.closes
    }
}

impl Outgoing {
    /// Makes room for a message of `bytes` bytes by dropping older messages of its topic. Returns `false`, counting the
    /// message as dropped, if there is none left to drop.
    pub(super) fn make_room(&mut self, channel: u32, bytes: usize) -> bool {
        loop {
            if self.charge(bytes).is_ok() {
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

    /// Returns the number of bytes queued, in flight and kept.
    fn buffered_bytes(&self) -> usize {
        let topics: usize = self.topics.values().map(Ring::bytes).sum();
        let sending = self.sending.iter().map(|sending| &sending.out);
        // Records of other lanes are counted there until they are acknowledged.
        let sending = sending.filter(|out| out.lane == RecordLane::Data);
        let under_way: usize = sending.chain(self.encoding.messages()).map(RingItem::memory_size).sum();
        let waiting = self.lanes.bytes() + self.lines.bytes() + topics;
        waiting + under_way + self.retransmit.bytes + self.retransmit.big
    }

    /// Charges `bytes` to the budget. The total is recomputed only after enough has accumulated.
    pub(super) fn charge(&mut self, bytes: usize) -> Result<(), Exceeded> {
        let uncounted = self.uncounted + bytes;
        if uncounted > UNCOUNTED {
            self.permit.count(self.buffered_bytes() + bytes)?;
            self.uncounted = 0;
        } else {
            self.uncounted = uncounted;
        }
        Ok(())
    }

    /// Returns memory that is no longer in use to the budget.
    pub(super) fn release_unused(&mut self) {
        if self.permit.bytes() > 0 {
            // A smaller amount always fits.
            let _ = self.permit.count(self.buffered_bytes().min(self.permit.bytes()));
        }
    }

    /// Drops messages until the limit is observed, after one was added to `channel`: first messages that are followed
    /// by newer ones, then any, each time from the topic with the most bytes. The newest message stays.
    pub(super) fn enforce_budget(&mut self, channel: u32) {
        loop {
            let topics = self.topics.iter().map(|(of, waiting)| (*of, required_load(waiting)));
            let topics: Vec<(u32, (usize, usize))> = topics.collect();
            let all: usize = topics.iter().map(|(_, (_, bytes))| bytes).sum();
            let last = self.topics.get(&channel).and_then(Ring::back);
            if all - last.map_or(0, RingItem::memory_size).min(all) <= EACH {
                return;
            }
            // Topics with more than one message come first.
            let others = topics.iter().filter(|(of, (count, _))| *of != channel || *count > 1);
            let biggest = others.max_by_key(|(_, (count, bytes))| (*count > 1 && *bytes > LITTLE, *bytes));
            let Some(&(of, _)) = biggest else { return };
            let Some(waiting) = self.topics.get_mut(&of) else {
                return;
            };
            let oldest = waiting.iter().position(OutgoingRecord::is_irreplaceable);
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
