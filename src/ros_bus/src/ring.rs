//! A queue of messages bounded in messages and bytes: new messages displace the oldest.
//!
//! It has no lock, waiter or counter of its own. Operations that drop messages return a [`DropTally`], which the owner
//! of the ring adds to the counter reported for its topic. Where some messages must be kept in preference to others,
//! the owner adds with [`Ring::append`] and selects what to drop with [`Ring::trim`].

use std::collections::VecDeque;
use std::ops::AddAssign;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;

/// An item of a ring. Its size must not change while it is queued.
pub trait RingItem {
    /// Returns the bytes of memory that the item uses while it is queued.
    fn memory_size(&self) -> usize;
}

impl RingItem for Bytes {
    fn memory_size(&self) -> usize {
        self.len()
    }
}

/// Capacity of a ring. One message always fits, whatever its size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RingBounds {
    /// Maximum number of messages; 0 counts as 1.
    pub messages: usize,
    /// Maximum size of all messages together, in bytes.
    pub bytes: usize,
}

impl RingBounds {
    /// Creates bounds for the queue of a subscriber or publisher: the given number of messages, and 64 MiB.
    pub fn with_messages(messages: usize) -> Self {
        Self { messages, bytes: 64 << 20 }
    }
}

/// Count of dropped messages.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[must_use = "whoever drops messages counts them"]
pub struct DropTally {
    /// Number of messages.
    pub messages: u64,
    /// Total size of the messages in bytes.
    pub bytes: u64,
}

impl DropTally {
    /// Creates the tally of a single message.
    pub fn from_message(message: &impl RingItem) -> Self {
        Self { messages: 1, bytes: message.memory_size() as u64 }
    }
}

impl AddAssign for DropTally {
    fn add_assign(&mut self, more: Self) {
        self.messages += more.messages;
        self.bytes += more.bytes;
    }
}

/// Counter of dropped messages; it outlives the queues that it counts for.
#[derive(Debug, Default)]
pub struct DropCount(AtomicU64);

impl DropCount {
    /// Adds dropped messages.
    pub fn add(&self, lost: DropTally) {
        if lost.messages > 0 {
            self.0.fetch_add(lost.messages, Ordering::Relaxed);
        }
    }

    /// Returns the number of dropped messages so far.
    pub fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

/// Messages in the order in which they were added.
#[derive(Debug)]
pub struct Ring<T> {
    bounds: RingBounds,
    waiting: VecDeque<T>,
    bytes: usize,
}

impl<T> Default for Ring<T> {
    /// Creates an empty ring that drops messages only at its owner's request.
    fn default() -> Self {
        let bounds = RingBounds { messages: usize::MAX, bytes: usize::MAX };
        Self { bounds, waiting: VecDeque::new(), bytes: 0 }
    }
}

impl<T: RingItem> Ring<T> {
    /// Creates an empty ring.
    pub fn new(bounds: RingBounds) -> Self {
        Self { bounds, waiting: VecDeque::new(), bytes: 0 }
    }

    /// Adds a message at the end; drops the oldest ones if there is no room.
    pub fn push(&mut self, message: T) -> DropTally {
        self.append(message);
        let bounds = self.bounds;
        self.trim(|ring| ring.exceeds(bounds).then_some(0))
    }

    /// Adds a message at the end, ignoring the bounds.
    pub fn append(&mut self, message: T) {
        self.insert(self.waiting.len(), message);
    }

    /// Adds a message before all others, ignoring the bounds: one that was taken and could not be sent.
    pub fn put_back(&mut self, message: T) {
        self.insert(0, message);
    }

    /// Inserts a message at index `at`, ignoring the bounds.
    ///
    /// # Panics
    /// If `at` is greater than the number of messages.
    pub fn insert(&mut self, at: usize, message: T) {
        self.bytes += message.memory_size();
        self.waiting.insert(at, message);
    }

    /// Drops messages one by one for as long as `victim` returns an index.
    pub fn trim(&mut self, victim: impl Fn(&Self) -> Option<usize>) -> DropTally {
        let mut lost = DropTally::default();
        while let Some(gone) = victim(self).and_then(|at| self.remove(at)) {
            lost += DropTally::from_message(&gone);
        }
        lost
    }

    /// Returns true if the ring holds more than these bounds allow.
    pub fn exceeds(&self, bounds: RingBounds) -> bool {
        let count = self.waiting.len();
        count > bounds.messages.max(1) || (count > 1 && self.bytes > bounds.bytes)
    }

    /// Removes and returns the oldest message.
    pub fn pop(&mut self) -> Option<T> {
        let oldest = self.waiting.pop_front()?;
        self.bytes -= oldest.memory_size();
        Some(oldest)
    }

    /// Removes and returns the message at index `at`.
    pub fn remove(&mut self, at: usize) -> Option<T> {
        let taken = self.waiting.remove(at)?;
        self.bytes -= taken.memory_size();
        Some(taken)
    }

    /// Removes all messages.
    pub fn clear(&mut self) {
        self.bytes = 0;
        self.waiting.clear();
    }

    /// Iterates over the messages, oldest first.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = &T> + DoubleEndedIterator + Clone {
        self.waiting.iter()
    }

    /// Returns the oldest message.
    pub fn front(&self) -> Option<&T> {
        self.waiting.front()
    }

    /// Returns the newest message.
    pub fn back(&self) -> Option<&T> {
        self.waiting.back()
    }

    /// Returns the number of messages.
    pub fn len(&self) -> usize {
        self.waiting.len()
    }

    /// Returns true if there are no messages.
    pub fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    /// Returns the size of all messages in bytes.
    pub fn bytes(&self) -> usize {
        self.bytes
    }
}

impl<T: RingItem> Iterator for Ring<T> {
    type Item = T;

    fn next(&mut self) -> Option<T> {
        self.pop()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn message(byte: u8, size: usize) -> Bytes {
        Bytes::from(vec![byte; size])
    }

    #[test]
    fn the_newest_stay() {
        let mut ring = Ring::new(RingBounds::with_messages(2));
        let count = DropCount::default();
        for n in 0..5 {
            count.add(ring.push(message(n, 10)));
        }
        assert_eq!((count.get(), ring.len(), ring.bytes()), (3, 2, 20));
        assert!(ring.eq([message(3, 10), message(4, 10)]));
    }

    #[test]
    fn one_message_always_fits() {
        let bounds = RingBounds { messages: 0, bytes: 10 };
        let mut ring = Ring::new(bounds);
        assert_eq!(ring.push(message(1, 100)), DropTally::default());
        let lost = ring.push(message(2, 1));
        assert_eq!((lost.messages, lost.bytes), (1, 100));
        assert_eq!(ring.pop(), Some(message(2, 1)));
        assert_eq!(ring.pop(), None);
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        /// For any sequence of pushes and removals: no message is lost uncounted, the order is kept and the bounds
        /// hold.
        #[test]
        fn every_message_is_taken_or_counted(
            messages in 0usize..5,
            bytes in 0usize..60,
            steps in prop::collection::vec((0usize..40, 0..4), 0..200),
        ) {
            let bounds = RingBounds { messages, bytes };
            let mut ring = Ring::new(bounds);
            let mut added = DropTally::default();
            let mut gone = DropTally::default();
            for (size, step) in steps {
                let new = message(0, size);
                let taken = match step {
                    0 => ring.pop(),
                    1 => ring.remove(size % 5),
                    _ => {
                        added += DropTally::from_message(&new);
                        None
                    }
                };
                if let Some(taken) = taken {
                    gone += DropTally::from_message(&taken);
                }
                match step {
                    2 => ring.insert(size.min(ring.len()), new),
                    3 => {
                        gone += ring.push(new);
                        prop_assert!(!ring.exceeds(bounds));
                        prop_assert_eq!(ring.back().map(Bytes::len), Some(size), "the newest stays");
                    }
                    _ => {}
                }
                prop_assert_eq!(added.messages - gone.messages, ring.len() as u64);
                prop_assert_eq!(added.bytes - gone.bytes, ring.bytes() as u64);
            }
            ring.clear();
            prop_assert_eq!((ring.bytes(), ring.is_empty()), (0, true));
        }
    }
}
