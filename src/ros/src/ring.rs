//! A queue of messages that holds at most so many messages and bytes: what is new takes the place of what is oldest.
//!
//! It has no lock, no waiter and no counter of its own. Whatever drops messages gives back a [`Lost`], and whoever holds the
//! ring adds that to the one counter that its topic is reported by. Where some messages may not go before others, the owner
//! adds with [`Ring::append`] and says which to drop ([`Ring::trim`]).

use std::collections::VecDeque;
use std::ops::AddAssign;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;

/// What a ring holds. Its size may not change while it is held.
pub trait Held {
    /// Bytes of memory that it takes while it waits.
    fn held(&self) -> usize;
}

impl Held for Bytes {
    fn held(&self) -> usize {
        self.len()
    }
}

/// How much a ring holds. One message always fits, however large.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounds {
    /// Messages; 0 counts as 1.
    pub messages: usize,
    /// Bytes of all messages together.
    pub bytes: usize,
}

impl Bounds {
    /// For the queue of a subscriber or publisher: so many messages, and 64 MiB.
    pub fn messages(messages: usize) -> Self {
        Self {
            messages,
            bytes: 64 << 20,
        }
    }
}

/// Messages that were dropped.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[must_use = "whoever drops messages counts them"]
pub struct Lost {
    /// The number of messages.
    pub messages: u64,
    /// Their bytes.
    pub bytes: u64,
}

impl Lost {
    /// One message.
    pub fn one(message: &impl Held) -> Self {
        Self {
            messages: 1,
            bytes: message.held() as u64,
        }
    }
}

impl AddAssign for Lost {
    fn add_assign(&mut self, more: Self) {
        self.messages += more.messages;
        self.bytes += more.bytes;
    }
}

/// Messages dropped so far; outlives the queues that it counts for.
#[derive(Debug, Default)]
pub struct DropCount(AtomicU64);

impl DropCount {
    /// Adds what was lost.
    pub fn add(&self, lost: Lost) {
        if lost.messages > 0 {
            self.0.fetch_add(lost.messages, Ordering::Relaxed);
        }
    }

    /// How many messages it is by now.
    pub fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

/// Messages in the order in which they came.
#[derive(Debug)]
pub struct Ring<T> {
    bounds: Bounds,
    waiting: VecDeque<T>,
    bytes: usize,
}

impl<T: Held> Ring<T> {
    /// An empty ring.
    pub fn new(bounds: Bounds) -> Self {
        Self {
            bounds,
            waiting: VecDeque::new(),
            bytes: 0,
        }
    }

    /// An empty ring of which only its owner drops something.
    pub fn unbounded() -> Self {
        Self::new(Bounds {
            messages: usize::MAX,
            bytes: usize::MAX,
        })
    }

    /// Adds a message at the end; the oldest are dropped for it.
    pub fn push(&mut self, message: T) -> Lost {
        self.append(message);
        let bounds = self.bounds;
        self.trim(|ring| ring.exceeds(bounds).then_some(0))
    }

    /// Adds a message at the end, beyond all bounds.
    pub fn append(&mut self, message: T) {
        self.insert(self.waiting.len(), message);
    }

    /// Adds a message before all others, beyond all bounds: one that was taken and could not be sent.
    pub fn put_back(&mut self, message: T) {
        self.insert(0, message);
    }

    /// Adds a message before the one at this place, beyond all bounds.
    ///
    /// # Panics
    /// If there are fewer messages.
    pub fn insert(&mut self, at: usize, message: T) {
        self.bytes += message.held();
        self.waiting.insert(at, message);
    }

    /// Drops messages, one by one, as long as `victim` names the place of one.
    pub fn trim(&mut self, victim: impl Fn(&Self) -> Option<usize>) -> Lost {
        let mut lost = Lost::default();
        while let Some(gone) = victim(self).and_then(|at| self.remove(at)) {
            lost += Lost::one(&gone);
        }
        lost
    }

    /// Whether more than these bounds is held.
    pub fn exceeds(&self, bounds: Bounds) -> bool {
        let count = self.waiting.len();
        count > bounds.messages.max(1) || (count > 1 && self.bytes > bounds.bytes)
    }

    /// Takes the oldest message.
    pub fn pop(&mut self) -> Option<T> {
        let oldest = self.waiting.pop_front()?;
        self.bytes -= oldest.held();
        Some(oldest)
    }

    /// Takes the message at this place.
    pub fn remove(&mut self, at: usize) -> Option<T> {
        let taken = self.waiting.remove(at)?;
        self.bytes -= taken.held();
        Some(taken)
    }

    /// Forgets all messages.
    pub fn clear(&mut self) {
        self.bytes = 0;
        self.waiting.clear();
    }

    /// The messages, oldest first.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = &T> + DoubleEndedIterator + Clone {
        self.waiting.iter()
    }

    /// The oldest message.
    pub fn front(&self) -> Option<&T> {
        self.waiting.front()
    }

    /// The newest message.
    pub fn back(&self) -> Option<&T> {
        self.waiting.back()
    }

    /// How many messages wait.
    pub fn len(&self) -> usize {
        self.waiting.len()
    }

    /// Whether none waits.
    pub fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    /// Bytes of all messages that wait.
    pub fn bytes(&self) -> usize {
        self.bytes
    }
}

impl<T: Held> Iterator for Ring<T> {
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
        let mut ring = Ring::new(Bounds::messages(2));
        let count = DropCount::default();
        for n in 0..5 {
            count.add(ring.push(message(n, 10)));
        }
        assert_eq!((count.get(), ring.len(), ring.bytes()), (3, 2, 20));
        assert!(ring.eq([message(3, 10), message(4, 10)]));
    }

    #[test]
    fn one_message_always_fits() {
        let bounds = Bounds {
            messages: 0,
            bytes: 10,
        };
        let mut ring = Ring::new(bounds);
        assert_eq!(ring.push(message(1, 100)), Lost::default());
        let lost = ring.push(message(2, 1));
        assert_eq!((lost.messages, lost.bytes), (1, 100));
        assert_eq!(ring.pop(), Some(message(2, 1)));
        assert_eq!(ring.pop(), None);
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        /// Whatever is pushed and taken: nothing is lost uncounted, the order stays, and the bounds hold.
        #[test]
        fn every_message_is_taken_or_counted(
            messages in 0usize..5,
            bytes in 0usize..60,
            steps in prop::collection::vec((0usize..40, 0..4), 0..200),
        ) {
            let bounds = Bounds { messages, bytes };
            let mut ring = Ring::new(bounds);
            let mut added = Lost::default();
            let mut gone = Lost::default();
            for (size, step) in steps {
                let new = message(0, size);
                let taken = match step {
                    0 => ring.pop(),
                    1 => ring.remove(size % 5),
                    _ => {
                        added += Lost::one(&new);
                        None
                    }
                };
                if let Some(taken) = taken {
                    gone += Lost::one(&taken);
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
