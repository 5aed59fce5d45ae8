//! A queue of messages that holds at most so many messages and bytes: what is new takes the place of what is oldest.
//!
//! It has no lock, no waiter and no counter of its own. [`Ring::push`] says how many messages had to go, and whoever
//! pushes adds that to the one counter that its topic is reported by.

use std::collections::VecDeque;

use bytes::Bytes;

use crate::bus::Message;

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

impl Held for Message {
    fn held(&self) -> usize {
        self.bytes.len()
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

    /// Adds a message at the end; returns how many of the oldest were dropped for it.
    #[must_use = "whoever drops messages counts them"]
    pub fn push(&mut self, message: T) -> u64 {
        let size = message.held();
        let mut dropped = 0;
        while self.waiting.len() >= self.bounds.messages.max(1)
            || self.bytes + size > self.bounds.bytes
        {
            if self.pop().is_none() {
                break;
            }
            dropped += 1;
        }
        self.bytes += size;
        self.waiting.push_back(message);
        dropped
    }

    /// Takes the oldest message.
    pub fn pop(&mut self) -> Option<T> {
        let oldest = self.waiting.pop_front()?;
        self.bytes -= oldest.held();
        Some(oldest)
    }

    /// Forgets all messages; returns how many there were.
    pub fn clear(&mut self) -> u64 {
        self.bytes = 0;
        let count = self.waiting.len();
        self.waiting.clear();
        count as u64
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
        let dropped: u64 = (0..5).map(|n| ring.push(message(n, 10))).sum();
        assert_eq!((dropped, ring.len(), ring.bytes()), (3, 2, 20));
        assert!(ring.eq([message(3, 10), message(4, 10)]));
    }

    #[test]
    fn one_message_always_fits() {
        let bounds = Bounds {
            messages: 0,
            bytes: 10,
        };
        let mut ring = Ring::new(bounds);
        assert_eq!(ring.push(message(1, 100)), 0);
        assert_eq!(ring.push(message(2, 1)), 1);
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
            steps in prop::collection::vec((0usize..40, any::<bool>()), 0..200),
        ) {
            let mut ring = Ring::new(Bounds { messages, bytes });
            let (mut pushed, mut gone) = (0u64, 0u64);
            for (size, takes) in steps {
                if takes {
                    gone += u64::from(ring.pop().is_some());
                } else {
                    pushed += 1;
                    gone += ring.push(message(0, size));
                    prop_assert!(ring.len() == 1 || ring.bytes() <= bytes);
                    prop_assert!(ring.len() <= messages.max(1));
                }
                prop_assert_eq!(pushed - gone, ring.len() as u64);
            }
            let left = ring.len() as u64;
            prop_assert_eq!(ring.clear(), left);
            prop_assert_eq!((ring.bytes(), ring.is_empty()), (0, true));
        }
    }
}
