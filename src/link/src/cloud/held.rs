//! Messages and calls that come while an output is being subscribed to wait until it is: whoever listens on the robot
//! is connected to the stub already, and shall hear what the node answers.

use std::collections::VecDeque;
use std::sync::Arc;

use parking_lot::Mutex;

use super::node_link::NodeLink;
use crate::record::Record;

/// More do not wait, and bytes of messages.
const MOST: (usize, usize) = (256, 32 << 20);

/// What waits, and for how many outputs.
#[derive(Default)]
pub(super) struct Held {
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    outputs: usize,
    bytes: usize,
    records: VecDeque<(Record, i64)>,
    /// Someone passes on what had waited: others queue up behind.
    passing: bool,
}

/// Bytes that it takes while it waits.
fn size(record: &Record) -> usize {
    match record {
        Record::Data(data) => data.message.len(),
        Record::Call { request, .. } => request.len(),
        _ => 0,
    }
}

impl State {
    fn is_due(&self) -> bool {
        self.outputs == 0 || self.records.len() >= MOST.0 || self.bytes >= MOST.1
    }
}

impl Held {
    /// Takes a record that must wait; gives back one that need not.
    pub(super) fn take(&self, record: Record, arrived: i64) -> Option<(Record, i64)> {
        let mut state = self.state.lock();
        if state.outputs == 0 && !state.passing && state.records.is_empty() {
            return Some((record, arrived));
        }
        state.bytes += size(&record);
        state.records.push_back((record, arrived));
        None
    }

    /// Passes on what need not wait any longer, in order.
    pub(super) fn pass(&self, mut to: impl FnMut(Record, i64)) {
        let mut state = self.state.lock();
        if state.passing {
            return;
        }
        state.passing = true;
        // Not while locked: `to` may take its time.
        while state.is_due() {
            let Some((record, arrived)) = state.records.pop_front() else {
                break;
            };
            state.bytes -= size(&record);
            drop(state);
            to(record, arrived);
            state = self.state.lock();
        }
        state.passing = false;
    }

    /// Nothing waits any longer, whatever was waited for.
    fn give_up(&self) {
        self.state.lock().outputs = 0;
    }
}

/// While this lives, messages and calls of the link wait; not longer than first messages of a topic do.
pub(super) struct Hold(Arc<NodeLink>);

impl Hold {
    pub(super) fn new(link: &Arc<NodeLink>) -> Self {
        link.held.state.lock().outputs += 1;
        if let Some(hub) = link.hub.upgrade() {
            let weak = Arc::downgrade(link);
            tokio::spawn(async move {
                tokio::time::sleep(hub.options.warm_up).await;
                if let Some(link) = weak.upgrade() {
                    link.held.give_up();
                    link.pass_held();
                }
            });
        }
        Self(Arc::clone(link))
    }
}

impl Drop for Hold {
    fn drop(&mut self) {
        {
            let mut state = self.0.held.state.lock();
            state.outputs = state.outputs.saturating_sub(1);
        }
        self.0.pass_held();
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;

    fn call(id: u32, size: usize) -> Record {
        Record::Call {
            id,
            service: 1,
            request: Bytes::from(vec![0; size]),
        }
    }

    fn passed(held: &Held) -> Vec<i64> {
        let mut passed = Vec::new();
        held.pass(|_, arrived| passed.push(arrived));
        passed
    }

    #[test]
    fn what_waits_passes_in_order_once_it_may() {
        let held = Held::default();
        assert!(held.take(call(0, 1), 0).is_some(), "nothing to wait for");
        held.state.lock().outputs = 1;
        for number in 1..4 {
            assert!(held.take(call(0, 1), number).is_none());
        }
        assert!(passed(&held).is_empty());
        held.give_up();
        // One that comes while others pass does not overtake them.
        let mut order = Vec::new();
        held.pass(|_, arrived| {
            if arrived == 1 {
                assert!(held.take(call(0, 1), 4).is_none());
            }
            order.push(arrived);
        });
        assert_eq!(order, [1, 2, 3, 4]);
        assert!(held.take(call(0, 1), 5).is_some());
    }

    #[test]
    fn not_too_much_waits() {
        let held = Held::default();
        held.state.lock().outputs = 1;
        for number in 0..300 {
            assert!(held.take(call(0, 1), number).is_none());
        }
        assert_eq!(passed(&held).len(), 300 - MOST.0 + 1);
        assert!(held.take(call(0, MOST.1), 300).is_none());
        assert_eq!(passed(&held).len(), MOST.0);
    }
}
