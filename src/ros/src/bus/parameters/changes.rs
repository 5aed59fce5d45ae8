//! Changes of parameters on their way to whoever watches them: of each key the last one, in bytes that somebody pays for.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use budget::{Budget, Exceeded, Permit};
use parking_lot::Mutex;
use tokio::sync::Notify;

use super::{ParamChange, ParamValue};

/// What a change takes besides its key and its value, in bytes.
const OVERHEAD: usize = 256;

/// Parameters as they change: key and value, or no value where one was deleted. Of a key that changes faster than it is read the
/// last value is told, after all that changed before it.
pub struct ParamChanges(Arc<Queue>);

/// Where changes are told that somebody watches. The watcher hears the end when this is dropped.
pub(crate) struct ParamTeller(Arc<Queue>);

struct Queue {
    waiting: Mutex<Waiting>,
    told: Notify,
    budget: Budget,
}

#[derive(Default)]
struct Waiting {
    changes: BTreeMap<u64, Change>,
    /// The numbers of the changes that wait, by key.
    numbers: HashMap<String, u64>,
    next: u64,
    closed: bool,
}

struct Change {
    change: ParamChange,
    _held: Permit,
}

/// The two ends of a watch. What waits counts in `budget`.
pub(crate) fn changes_within(budget: &Budget) -> (ParamTeller, ParamChanges) {
    let queue = Arc::new(Queue {
        waiting: Mutex::default(),
        told: Notify::new(),
        budget: budget.clone(),
    });
    (ParamTeller(Arc::clone(&queue)), ParamChanges(queue))
}

impl ParamTeller {
    /// Tells a change.
    ///
    /// # Errors
    /// There is no memory for it: it is not told.
    pub(crate) fn tell(&self, key: String, value: Option<ParamValue>) -> Result<(), Exceeded> {
        let bytes = OVERHEAD + 2 * key.len() + value.as_ref().map_or(0, ParamValue::bytes_held);
        {
            let mut waiting = self.0.waiting.lock();
            // What it had before is of no use any more, whatever becomes of this one.
            if let Some(before) = waiting.numbers.remove(&key) {
                waiting.changes.remove(&before);
            }
            let held = self.0.budget.take(bytes)?;
            let number = waiting.next;
            waiting.next += 1;
            waiting.numbers.insert(key.clone(), number);
            let change = Change {
                change: (key, value),
                _held: held,
            };
            waiting.changes.insert(number, change);
        }
        self.0.told.notify_one();
        Ok(())
    }
}

impl Drop for ParamTeller {
    fn drop(&mut self) {
        self.0.waiting.lock().closed = true;
        self.0.told.notify_one();
    }
}

impl ParamChanges {
    /// The next change; none when there will be no more.
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
    /// About how much memory it takes, in bytes.
    pub fn bytes_held(&self) -> usize {
        let own = size_of::<Self>();
        own + match self {
            Self::Bool(_) | Self::Int(_) | Self::Double(_) | Self::Nil => 0,
            Self::String(text) => text.len(),
            Self::Binary(bytes) => bytes.len(),
            Self::List(items) => items.iter().map(Self::bytes_held).sum(),
            Self::Map(members) => members
                .iter()
                .map(|(name, member)| size_of::<String>() + name.len() + member.bytes_held())
                .sum(),
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
        let (teller, mut changes) = changes_within(&Budget::unlimited());
        for number in 0..1000 {
            teller.tell("/a".into(), value(number)).expect("memory");
        }
        teller.tell("/a/b".into(), value(1)).expect("memory");
        teller.tell("/c".into(), None).expect("memory");
        teller.tell("/a".into(), value(7)).expect("memory");
        for expected in [("/a/b", value(1)), ("/c", None), ("/a", value(7))] {
            let (key, value) = changes.recv().await.expect("a change");
            assert_eq!((&*key, value), expected);
        }
        assert!(changes.recv().now_or_never().is_none(), "it is told all");
        teller.tell("/a".into(), None).expect("memory");
        drop(teller);
        assert_eq!(changes.recv().await, Some(("/a".into(), None)));
        assert_eq!(changes.recv().await, None);
    }

    #[tokio::test]
    async fn what_is_not_read_is_paid_for_and_has_an_end() {
        let budget = Budget::new("parameters", 1 << 20);
        let (teller, mut changes) = changes_within(&budget);
        let text = || Some(ParamValue::String("x".repeat(10_000)));
        let told = (0..1000).map(|number| teller.tell(format!("/{number}"), text()));
        let told = told.filter(Result::is_ok).count();
        assert!((90..=104).contains(&told), "{told} are told");
        assert!(budget.used() > 900_000, "{} bytes count", budget.used());
        let refused = teller.tell("/more".into(), text()).expect_err("no memory");
        assert_eq!(refused.name, "parameters");
        // One that is read makes room for another.
        assert_eq!(changes.recv().await.expect("a change").0, "/0");
        teller.tell("/more".into(), text()).expect("memory");
        drop(changes);
        drop(teller);
        assert_eq!(budget.used(), 0);
    }
}
