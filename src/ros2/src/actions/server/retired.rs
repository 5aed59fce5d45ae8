//! Result services of action servers that are gone: a client that has just been told that its goal was accepted
//! requests the result a moment later, and would wait forever if nobody answered.

use std::sync::Arc;

use crate::state::{BoxedGuard, Ros2BusState};

/// Keeps a retired service running; dropping it ends the service.
pub(super) struct RetiredGuard {
    bus: Arc<Ros2BusState>,
    action: String,
    number: u64,
}

impl RetiredGuard {
    /// Keeps the service of this action running, unless another server takes over the action.
    pub(super) fn keep(bus: &Arc<Ros2BusState>, action: &str, guard: BoxedGuard) -> Self {
        let mut actions = bus.retired.actions.lock();
        actions.count += 1;
        let number = actions.count;
        let before = actions.kept.insert(action.to_owned(), (number, guard));
        drop(actions);
        // Dropping it takes locks of its own.
        drop(before);
        Self { bus: bus.clone(), action: action.to_owned(), number }
    }
}

impl Drop for RetiredGuard {
    fn drop(&mut self) {
        let mut actions = self.bus.retired.actions.lock();
        let kept = actions.kept.get(&self.action);
        let is_this = kept.is_some_and(|(number, _)| *number == self.number);
        let ended = is_this.then(|| actions.kept.remove(&self.action));
        drop(actions);
        drop(ended);
    }
}

/// Ends the retired service because another server takes over the action.
pub(super) fn release_retired(bus: &Ros2BusState, action: &str) {
    let ended = bus.retired.actions.lock().kept.remove(action);
    drop(ended);
}
