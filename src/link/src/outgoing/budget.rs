//! Limits on the bytes queued for the peer: for messages that must all be delivered (latched messages, messages of
//! actions), which within the limit are not replaced by newer ones; and for everything, in the budget of the session's
//! owner.

use ::budget::{Exceeded, UNCOUNTED};
use ros::ring::{Ring, RingItem};

use super::lanes::RecordLane;
use super::{Outgoing, OutgoingRecord};
use crate::drops::Cause;
use crate::limits::MAX_EACH_BYTES;

/// Number of bytes below which a topic's messages are not dropped while another topic holds more than its last message.
const LITTLE: usize = 1 << 20;

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
        while self.charge(bytes).is_err() {
            let waiting = self.topics.get_mut(&channel).filter(|all| all.len() > 1);
            let replaced = waiting.and_then(|waiting| {
                let oldest = waiting.iter().position(|out| !out.each)?;
                waiting.remove(oldest)
            });
            let cause = if replaced.is_some() { Cause::Replaced } else { Cause::Full };
            self.dropped.add(channel, cause, 1);
            if cause == Cause::Full {
                return false;
            }
        }
        true
    }

    /// Returns the number of bytes queued, in flight and kept.
    pub(crate) fn buffered_bytes(&self) -> usize {
        let topics: usize = self.topics.values().map(Ring::bytes).sum();
        let sending = self.sending.iter().map(|sending| &sending.out);
        // Records of other lanes are counted there from the beginning.
        let sending = sending.filter(|out| out.lane == RecordLane::Data);
        let under_way: usize = sending.chain(self.encoding.message()).map(RingItem::memory_size).sum();
        self.lanes.bytes() + topics + under_way
    }

    /// Charges `bytes` to the budget. The total is recomputed only after enough has accumulated.
    pub(super) fn charge(&mut self, bytes: usize) -> Result<(), Exceeded> {
        let uncounted = self.uncounted + bytes;
        if uncounted > UNCOUNTED {
            let all = self.buffered_bytes() + bytes;
            self.permit.as_mut().map_or(Ok(()), |permit| permit.count(all))?;
            self.uncounted = 0;
        } else {
            self.uncounted = uncounted;
        }
        Ok(())
    }

    /// Returns memory that is no longer in use to the budget.
    pub(super) fn release_unused(&mut self) {
        if let Some(mut permit) = self.permit.take_if(|permit| permit.bytes() > 0) {
            // A smaller amount always fits.
            let _ = permit.count(self.buffered_bytes().min(permit.bytes()));
            self.permit = Some(permit);
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
            if all.saturating_sub(last.map_or(0, RingItem::memory_size)) <= MAX_EACH_BYTES {
                return;
            }
            // Topics with more than one message come first.
            let others = topics.iter().filter(|(of, (count, _))| *of != channel || *count > 1);
            let biggest = others.max_by_key(|(_, (count, bytes))| (*count > 1 && *bytes > LITTLE, *bytes));
            let shortened = biggest.and_then(|(of, _)| {
                let waiting = self.topics.get_mut(of)?;
                let oldest = waiting.iter().position(OutgoingRecord::is_irreplaceable)?;
                waiting.remove(oldest)?;
                Some((*of, waiting.is_empty()))
            });
            let Some((of, is_empty)) = shortened else { return };
            if is_empty {
                self.turns.withdraw(of);
            }
            self.dropped.add(of, Cause::Full, 1);
        }
    }
}
