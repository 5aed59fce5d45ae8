//! Holds back messages and calls while an output is being subscribed to: the subscriber on the robot is already
//! connected to the stub and must receive the node's answers.

use std::sync::Arc;

use super::state::{HeldRecord, HoldGuard, HoldQueue, HoldState, NodeLink};
use link::record::Record;
use ros::ring;

/// Maximum number of records held back, and of bytes.
const MAX_HELD: (usize, usize) = (256, 32 << 20);

impl ring::RingItem for HeldRecord {
    fn memory_size(&self) -> usize {
        match &self.record {
            Record::Data(data) => data.message.len(),
            Record::Call(call) => call.request.len(),
            _ => 0,
        }
    }
}

impl HoldState {
    fn is_due(&self) -> bool {
        self.holds.is_empty() || self.records.len() >= MAX_HELD.0 || self.records.bytes() >= MAX_HELD.1
    }
}

impl HoldQueue {
    /// Queues a record that must wait; returns one that need not.
    pub(super) fn try_hold(&self, arrival: HeldRecord) -> Option<HeldRecord> {
        let mut state = self.state.lock();
        if state.holds.is_empty() && !state.passing && state.records.is_empty() {
            return Some(arrival);
        }
        state.records.append(arrival);
        None
    }

    /// Passes on records that need not wait any longer, in order.
    pub(super) fn drain_ready(&self, mut to: impl FnMut(HeldRecord)) {
        let mut state = self.state.lock();
        if state.passing {
            return;
        }
        state.passing = true;
        // Not while locked, because `to` may take time.
        while state.is_due() {
            let Some(arrival) = state.records.pop() else {
                break;
            };
            drop(state);
            to(arrival);
            state = self.state.lock();
        }
        state.passing = false;
    }

    /// Adds a hold; returns its number.
    fn add_hold(&self) -> u64 {
        let mut state = self.state.lock();
        let number = state.next;
        state.next += 1;
        state.holds.insert(number);
        number
    }

    /// Removes a hold.
    fn remove_hold(&self, number: u64) {
        self.state.lock().holds.remove(&number);
    }
}

impl HoldGuard {
    pub(super) fn new(link: &Arc<NodeLink>) -> Self {
        let number = link.held.add_hold();
        if let Some(hub) = link.hub.upgrade() {
            let weak = Arc::downgrade(link);
            tokio::spawn(async move {
                tokio::time::sleep(hub.options.warm_up).await;
                if let Some(link) = weak.upgrade() {
                    link.held.remove_hold(number);
                    link.drain_held();
                }
            });
        }
        Self { link: Arc::clone(link), number }
    }
}

impl Drop for HoldGuard {
    fn drop(&mut self) {
        self.link.held.remove_hold(self.number);
        self.link.drain_held();
    }
}

#[cfg(test)]
mod tests {
    use budget::Budget;
    use bytes::Bytes;

    use super::*;

    fn call(size: usize, at: i64) -> HeldRecord {
        let record = Record::Call(link::record::Call { id: 0, service: 1, request: Bytes::from(vec![0; size]) });
        let held = Budget::without_limit().permit();
        HeldRecord { record, held, at }
    }

    fn drain(held: &HoldQueue) -> Vec<i64> {
        let mut passed = Vec::new();
        held.drain_ready(|arrival| passed.push(arrival.at));
        passed
    }

    #[test]
    fn what_waits_passes_in_order_once_it_may() {
        let held = HoldQueue::default();
        assert!(held.try_hold(call(1, 0)).is_some(), "nothing to wait for");
        let hold = held.add_hold();
        for number in 1..4 {
            assert!(held.try_hold(call(1, number)).is_none());
        }
        assert!(drain(&held).is_empty());
        held.remove_hold(hold);
        // A record that arrives while others are passed on does not overtake them.
        let mut order = Vec::new();
        held.drain_ready(|arrival| {
            if arrival.at == 1 {
                assert!(held.try_hold(call(1, 4)).is_none());
            }
            order.push(arrival.at);
        });
        assert_eq!(order, [1, 2, 3, 4]);
        assert!(held.try_hold(call(1, 5)).is_some());
    }

    #[test]
    fn what_one_output_has_waited_for_long_enough_another_may_still_wait_for() {
        let held = HoldQueue::default();
        let first = held.add_hold();
        let second = held.add_hold();
        assert!(held.try_hold(call(1, 1)).is_none());
        // The first hold expires; then its output is subscribed to, which does not affect the second.
        held.remove_hold(first);
        assert!(drain(&held).is_empty());
        held.remove_hold(first);
        assert!(drain(&held).is_empty());
        held.remove_hold(second);
        assert_eq!(drain(&held), [1]);
    }

    #[test]
    fn not_too_much_waits() {
        let held = HoldQueue::default();
        held.add_hold();
        for number in 0..300 {
            assert!(held.try_hold(call(1, number)).is_none());
        }
        assert_eq!(drain(&held).len(), 300 - MAX_HELD.0 + 1);
        assert!(held.try_hold(call(MAX_HELD.1, 300)).is_none());
        assert_eq!(drain(&held).len(), MAX_HELD.0);
    }
}
