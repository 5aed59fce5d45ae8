//! Where results are asked for of servers that are gone: whoever has just been told that its goal was accepted asks a moment
//! later, and would wait for ever if nobody answered.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::Mutex;

use crate::ros2::bus::Inner;

/// What serves something until it is dropped.
pub(super) type Guard = Box<dyn Send + Sync>;

/// The services of a bus that answer a little longer, by the action that they are of.
#[derive(Default)]
pub(in crate::ros2) struct Retired {
    actions: Mutex<Actions>,
}

#[derive(Default)]
struct Actions {
    count: u64,
    kept: HashMap<String, (u64, Guard)>,
}

/// Keeps a service; dropping it ends that.
pub(super) struct Keeping {
    bus: Arc<Inner>,
    action: String,
    number: u64,
}

impl Keeping {
    /// Keeps the service of this action, unless another server takes the action over.
    pub(super) fn of(bus: &Arc<Inner>, action: &str, guard: Guard) -> Self {
        let mut actions = bus.retired.actions.lock();
        actions.count += 1;
        let number = actions.count;
        let before = actions.kept.insert(action.to_owned(), (number, guard));
        drop(actions);
        // It takes locks of its own.
        drop(before);
        Self {
            bus: bus.clone(),
            action: action.to_owned(),
            number,
        }
    }
}

impl Drop for Keeping {
    fn drop(&mut self) {
        let mut actions = self.bus.retired.actions.lock();
        let kept = actions.kept.get(&self.action);
        let is_this = kept.is_some_and(|(number, _)| *number == self.number);
        let ended = is_this.then(|| actions.kept.remove(&self.action));
        drop(actions);
        drop(ended);
    }
}

/// Another server takes the action over.
pub(super) fn take_over(bus: &Inner, action: &str) {
    let ended = bus.retired.actions.lock().kept.remove(action);
    drop(ended);
}
