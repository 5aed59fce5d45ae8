//! Messages and calls that come while an output is being subscribed to wait until it is: whoever listens on the robot
//! is connected to the stub already, and shall hear what the node answers.

use std::collections::BTreeSet;
use std::sync::Arc;

use budget::Permit;
use parking_lot::Mutex;

use super::node_link::NodeLink;
use link::control::FromRobot;
use link::record::Record;
use ros::ring::{self, Ring};

/// More do not wait, and bytes of messages.
const MOST: (usize, usize) = (256, 32 << 20);

/// What waits, and for how many outputs.
#[derive(Default)]
pub(super) struct Held {
    state: Mutex<State>,
}

struct State {
    /// The things that are waited for, by number.
    holds: BTreeSet<u64>,
    next: u64,
    records: Ring<Arrival>,
    /// Someone passes on what had waited: others queue up behind.
    passing: bool,
}

impl Default for State {
    fn default() -> Self {
        Self {
            holds: BTreeSet::new(),
            next: 0,
            // None is dropped: beyond what may wait, the oldest pass.
            records: Ring::unbounded(),
            passing: false,
        }
    }
}

/// A record that has come.
pub(super) struct Arrival {
    pub(super) record: Record<FromRobot>,
    /// An order or call counts as the robot's until this is dropped.
    pub(super) held: Permit,
    /// When it had come (nanoseconds since 1970).
    pub(super) at: i64,
}

impl ring::Held for Arrival {
    fn held(&self) -> usize {
        match &self.record {
            Record::Data(data) => data.message.len(),
            Record::Call { request, .. } => request.len(),
            _ => 0,
        }
    }
}

impl State {
    fn is_due(&self) -> bool {
        self.holds.is_empty() || self.records.len() >= MOST.0 || self.records.bytes() >= MOST.1
    }
}

impl Held {
    /// Takes a record that must wait; gives back one that need not.
    pub(super) fn take(&self, arrival: Arrival) -> Option<Arrival> {
        let mut state = self.state.lock();
        if state.holds.is_empty() && !state.passing && state.records.is_empty() {
            return Some(arrival);
        }
        state.records.append(arrival);
        None
    }

    /// Passes on what need not wait any longer, in order.
    pub(super) fn pass(&self, mut to: impl FnMut(Arrival)) {
        let mut state = self.state.lock();
        if state.passing {
            return;
        }
        state.passing = true;
        // Not while locked: `to` may take its time.
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

    /// Adds a thing to wait for; returns its number.
    fn hold(&self) -> u64 {
        let mut state = self.state.lock();
        let number = state.next;
        state.next += 1;
        state.holds.insert(number);
        number
    }

    /// Removes a thing to wait for.
    fn release(&self, number: u64) {
        self.state.lock().holds.remove(&number);
    }
}

/// While this lives, messages and calls of the link wait; not longer than first messages of a topic do.
pub(super) struct Hold {
    link: Arc<NodeLink>,
    number: u64,
}

impl Hold {
    pub(super) fn new(link: &Arc<NodeLink>) -> Self {
        let number = link.held.hold();
        if let Some(hub) = link.hub.upgrade() {
            let weak = Arc::downgrade(link);
            tokio::spawn(async move {
                tokio::time::sleep(hub.options.warm_up).await;
                if let Some(link) = weak.upgrade() {
                    link.held.release(number);
                    link.pass_held();
                }
            });
        }
        Self {
            link: Arc::clone(link),
            number,
        }
    }
}

impl Drop for Hold {
    fn drop(&mut self) {
        self.link.held.release(self.number);
        self.link.pass_held();
    }
}

#[cfg(test)]
mod tests {
    use budget::Budget;
    use bytes::Bytes;

    use super::*;

    fn call(size: usize, at: i64) -> Arrival {
        let record = Record::Call {
            id: 0,
            service: 1,
            request: Bytes::from(vec![0; size]),
        };
        let held = Budget::unlimited().permit();
        Arrival { record, held, at }
    }

    fn passed(held: &Held) -> Vec<i64> {
        let mut passed = Vec::new();
        held.pass(|arrival| passed.push(arrival.at));
        passed
    }

    #[test]
    fn what_waits_passes_in_order_once_it_may() {
        let held = Held::default();
        assert!(held.take(call(1, 0)).is_some(), "nothing to wait for");
        let hold = held.hold();
        for number in 1..4 {
            assert!(held.take(call(1, number)).is_none());
        }
        assert!(passed(&held).is_empty());
        held.release(hold);
        // One that comes while others pass does not overtake them.
        let mut order = Vec::new();
        held.pass(|arrival| {
            if arrival.at == 1 {
                assert!(held.take(call(1, 4)).is_none());
            }
            order.push(arrival.at);
        });
        assert_eq!(order, [1, 2, 3, 4]);
        assert!(held.take(call(1, 5)).is_some());
    }

    #[test]
    fn what_one_output_has_waited_for_long_enough_another_may_still_wait_for() {
        let held = Held::default();
        let first = held.hold();
        let second = held.hold();
        assert!(held.take(call(1, 1)).is_none());
        // The first one's time is up; then it is subscribed to, which changes nothing for the second.
        held.release(first);
        assert!(passed(&held).is_empty());
        held.release(first);
        assert!(passed(&held).is_empty());
        held.release(second);
        assert_eq!(passed(&held), [1]);
    }

    #[test]
    fn not_too_much_waits() {
        let held = Held::default();
        held.hold();
        for number in 0..300 {
            assert!(held.take(call(1, number)).is_none());
        }
        assert_eq!(passed(&held).len(), 300 - MOST.0 + 1);
        assert!(held.take(call(MOST.1, 300)).is_none());
        assert_eq!(passed(&held).len(), MOST.0);
    }
}
