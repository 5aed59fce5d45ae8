//! Slots: how many of a limited thing each of its holders has at once.

use std::collections::HashMap;
use std::hash::Hash;
use std::sync::Arc;

use parking_lot::Mutex;

type SlotCounts<K> = Arc<Mutex<HashMap<K, usize>>>;

/// Slots by their holder, such as a principal.
#[derive(Debug)]
pub struct Slots<K: Eq + Hash>(SlotCounts<K>);

/// One slot of a holder; released when dropped.
#[derive(Debug)]
pub struct Slot<K: Eq + Hash> {
    counts: SlotCounts<K>,
    holder: K,
}

impl<K: Eq + Hash> Default for Slots<K> {
    fn default() -> Self {
        Slots(Arc::default())
    }
}

impl<K: Clone + Eq + Hash> Slots<K> {
    /// Acquires a slot for this holder; `None` if it has `most` of them.
    pub fn acquire(&self, holder: K, most: usize) -> Option<Slot<K>> {
        let mut counts = self.0.lock();
        let own = counts.entry(holder.clone()).or_default();
        if *own >= most {
            return None;
        }
        *own += 1;
        Some(Slot { counts: Arc::clone(&self.0), holder })
    }

    /// Returns whether nobody has a slot.
    #[cfg(test)]
    pub fn is_empty(&self) -> bool {
        self.0.lock().is_empty()
    }
}

impl<K: Eq + Hash> Drop for Slot<K> {
    fn drop(&mut self) {
        let mut counts = self.counts.lock();
        if let Some(own) = counts.get_mut(&self.holder) {
            *own -= 1;
            if *own == 0 {
                counts.remove(&self.holder);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_holder_has_so_many_and_no_more() {
        let slots = Slots::default();
        let mut own: Vec<_> = (0..4).map(|_| slots.acquire("alice", 4).expect("room")).collect();
        assert!(slots.acquire("alice", 4).is_none(), "hers are taken");
        let other = slots.acquire("bob", 4).expect("his own");
        own.pop();
        own.push(slots.acquire("alice", 4).expect("room again"));
        drop((own, other));
        assert!(slots.is_empty(), "nothing is left behind");
    }
}
