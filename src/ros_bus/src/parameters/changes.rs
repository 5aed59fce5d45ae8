//! Queue of parameter changes for a watcher: holds the last change of each key, within a memory budget.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use budget::{Budget, Exceeded, Permit};
use parking_lot::Mutex;
use tokio::sync::Notify;

use super::{ParamChange, ParamValue};

/// Bytes charged for a change in addition to its key and value.
const OVERHEAD: usize = 256;

/// Parameter changes: key and value, or no value for a deleted parameter. If a key changes faster than it is read, only
/// its last value is delivered, after everything that changed before it.
pub struct ParamChangeReceiver(Arc<ChangeQueue>);

/// Sends changes to a watcher. The watcher sees the end of the stream when this is dropped.
pub struct ParamChangeSender(Arc<ChangeQueue>);

struct ChangeQueue {
    waiting: Mutex<PendingChanges>,
    told: Notify,
    budget: Budget,
}

#[derive(Default)]
struct PendingChanges {
    changes: BTreeMap<u64, Change>,
    /// Sequence numbers of the queued changes, by key.
    numbers: HashMap<String, u64>,
    next: u64,
    closed: bool,
}

struct Change {
    change: ParamChange,
    _held: Permit,
}

/// Creates the two ends of a watch. Queued changes are charged to `budget`.
pub fn param_change_channel(budget: &Budget) -> (ParamChangeSender, ParamChangeReceiver) {
    let queue = Arc::new(ChangeQueue { waiting: Mutex::default(), told: Notify::new(), budget: budget.clone() });
    (ParamChangeSender(Arc::clone(&queue)), ParamChangeReceiver(queue))
}

impl ParamChangeSender {
    /// Sends a change.
    ///
    /// # Errors
    /// The budget is exhausted; the change is not sent.
    pub fn send(&self, key: String, value: Option<ParamValue>) -> Result<(), Exceeded> {
        let bytes = OVERHEAD + 2 * key.len() + value.as_ref().map_or(0, ParamValue::bytes_held);
        {
            let mut waiting = self.0.waiting.lock();
            // The earlier change of this key is obsolete, whatever happens to the new one.
            if let Some(before) = waiting.numbers.remove(&key) {
                waiting.changes.remove(&before);
            }
            let held = self.0.budget.take(bytes)?;
            let number = waiting.next;
            waiting.next += 1;
            waiting.numbers.insert(key.clone(), number);
            let change = Change { change: (key, value), _held: held };
            waiting.changes.insert(number, change);
        }
        self.0.told.notify_one();
        Ok(())
    }

    /// Returns true if the watcher is gone.
    pub fn is_closed(&self) -> bool {
        // There are two ends.
        Arc::strong_count(&self.0) == 1
    }
}

impl Drop for ParamChangeSender {
    fn drop(&mut self) {
        self.0.waiting.lock().closed = true;
        self.0.told.notify_one();
    }
}

impl ParamChangeReceiver {
    /// Returns the next change, or `None` at the end of the stream.
    pub async fn recv(&mut self) -> Option<ParamChange> {
        loop {
            {
                let mut waiting = self.0.waiting.lock();
                if let Some((_, Change { change, .. })) = waiting.changes.pop_first() {
                    waiting.numbers.remove(&change.0);
                    return Some(change);
                }
                if waiting.closed {
                    return None;
                }
            }
            self.0.told.notified().await;
        }
    }
}

impl ParamValue {
    /// Returns the approximate memory used, in bytes.
    pub fn bytes_held(&self) -> usize {
        let own = size_of::<Self>();
        own + match self {
            Self::Bool(_) | Self::Int(_) | Self::Double(_) | Self::Nil => 0,
            Self::String(text) => text.len(),
            Self::Binary(bytes) => bytes.len(),
            Self::List(items) => items.iter().map(Self::bytes_held).sum(),
            Self::Map(members) => {
                members.iter().map(|(name, member)| size_of::<String>() + name.len() + member.bytes_held()).sum()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt;

    use super::*;

    fn value(number: i64) -> Option<ParamValue> {
        Some(ParamValue::Int(number))
    }

    #[tokio::test]
    async fn of_a_key_the_last_change_is_told_after_those_before_it() {
        let (teller, mut changes) = param_change_channel(&Budget::without_limit());
        for number in 0..1000 {
            teller.send("/a".into(), value(number)).expect("memory");
        }
        teller.send("/a/b".into(), value(1)).expect("memory");
        teller.send("/c".into(), None).expect("memory");
        teller.send("/a".into(), value(7)).expect("memory");
        for expected in [("/a/b", value(1)), ("/c", None), ("/a", value(7))] {
            let (key, value) = changes.recv().await.expect("a change");
            assert_eq!((&*key, value), expected);
        }
        assert!(changes.recv().now_or_never().is_none(), "it is told all");
        assert!(!teller.is_closed());
        teller.send("/a".into(), None).expect("memory");
        drop(teller);
        assert_eq!(changes.recv().await, Some(("/a".into(), None)));
        assert_eq!(changes.recv().await, None);
        let (teller, changes) = param_change_channel(&Budget::without_limit());
        drop(changes);
        assert!(teller.is_closed());
    }

    #[tokio::test]
    async fn what_is_not_read_is_paid_for_and_has_an_end() {
        let budget = Budget::new("parameters", 1 << 20);
        let (teller, mut changes) = param_change_channel(&budget);
        let text = || Some(ParamValue::String("x".repeat(10_000)));
        let told = (0..1000).map(|number| teller.send(format!("/{number}"), text()));
        let told = told.filter(Result::is_ok).count();
        assert!((90..=104).contains(&told), "{told} are told");
        assert!(budget.used_bytes() > 900_000, "{} bytes count", budget.used_bytes());
        let refused = teller.send("/more".into(), text()).expect_err("no memory");
        assert_eq!(refused.name, "parameters");
        // Reading one change makes room for another.
        assert_eq!(changes.recv().await.expect("a change").0, "/0");
        teller.send("/more".into(), text()).expect("memory");
        drop(changes);
        drop(teller);
        assert_eq!(budget.used_bytes(), 0);
    }
}
