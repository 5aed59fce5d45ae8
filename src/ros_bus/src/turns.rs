//! Round-robin scheduling of queues: each queue with work has one turn, then goes behind the others.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Instant;

/// Keys of queues waiting to be served.
#[derive(Debug)]
pub struct RoundRobin<K> {
    ready: VecDeque<K>,
    /// Queues that become ready later, with the time.
    later: BTreeSet<(Instant, K)>,
    /// State of every queue that is not forgotten, so that a queue that is enqueued repeatedly only changes its entry.
    places: BTreeMap<K, QueueState>,
}

#[derive(Debug, Clone, Copy, Default)]
enum QueueState {
    #[default]
    None,
    Ready,
    Later(Instant),
    /// The queue is not scheduled until it is released.
    Held,
}

impl<K> Default for RoundRobin<K> {
    fn default() -> Self {
        Self { ready: VecDeque::new(), later: BTreeSet::new(), places: BTreeMap::new() }
    }
}

impl<K: Copy + Ord> RoundRobin<K> {
    /// Schedules a queue that has work, behind all waiting queues. No effect if it is already waiting or is held.
    pub fn enqueue(&mut self, key: K) {
        let state = self.places.entry(key).or_default();
        if let QueueState::None = state {
            *state = QueueState::Ready;
            self.ready.push_back(key);
        }
    }

    /// Schedules a queue like [`enqueue`](Self::enqueue), but not before `due`.
    pub fn enqueue_at(&mut self, key: K, due: Instant, now: Instant) {
        if due <= now {
            return self.enqueue(key);
        }
        let state = self.places.entry(key).or_default();
        if let QueueState::None = state {
            *state = QueueState::Later(due);
            self.later.insert((due, key));
        }
    }

    /// Moves the queues that are due by `now` to the ready queues.
    pub fn wake_due(&mut self, now: Instant) {
        while let Some((due, key)) = self.later.first().copied().filter(|(due, _)| *due <= now) {
            self.later.remove(&(due, key));
            self.places.insert(key, QueueState::Ready);
            self.ready.push_back(key);
        }
    }

    /// Removes and returns the first ready queue for which `may` returns true; if it has more work it must be enqueued
    /// again.
    pub fn take(&mut self, mut may: impl FnMut(&K) -> bool) -> Option<K> {
        let key = match self.ready.front() {
            Some(first) if may(first) => self.ready.pop_front()?,
            _ => {
                let at = self.ready.iter().position(may)?;
                self.ready.remove(at)?
            }
        };
        if let Some(state) = self.places.get_mut(&key) {
            *state = QueueState::None;
        }
        Some(key)
    }

    /// Excludes a queue from scheduling until it is [released](Self::release).
    pub fn hold(&mut self, key: K) {
        self.withdraw(key);
        self.places.insert(key, QueueState::Held);
    }

    /// Lets a held queue be enqueued again.
    pub fn release(&mut self, key: K) {
        if let Some(state @ QueueState::Held) = self.places.get_mut(&key) {
            *state = QueueState::None;
        }
    }

    /// Removes a queue that has no more work; a held queue stays held.
    pub fn withdraw(&mut self, key: K) {
        let Some(state) = self.places.get_mut(&key) else {
            return;
        };
        match state {
            QueueState::Ready => self.ready.retain(|other| *other != key),
            QueueState::Later(due) => {
                self.later.remove(&(*due, key));
            }
            QueueState::Held | QueueState::None => return,
        }
        *state = QueueState::None;
    }

    /// Removes a queue altogether.
    pub fn forget(&mut self, key: K) {
        self.withdraw(key);
        self.places.remove(&key);
    }

    /// Returns true if no queue is ready.
    pub fn is_empty(&self) -> bool {
        self.ready.is_empty()
    }

    /// Returns the time at which the next deferred queue becomes ready.
    pub fn next_due(&self) -> Option<Instant> {
        self.later.first().map(|(due, _)| *due)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use proptest::prelude::*;

    use super::*;

    fn all(turns: &mut RoundRobin<u32>) -> Vec<u32> {
        std::iter::from_fn(|| turns.take(|_| true)).collect()
    }

    #[test]
    fn each_has_one_turn() {
        let mut turns = RoundRobin::default();
        for key in [1, 2, 1, 3, 1] {
            turns.enqueue(key);
        }
        assert_eq!(turns.take(|key| *key != 1), Some(2));
        turns.enqueue(2);
        assert_eq!(all(&mut turns), [1, 3, 2]);
    }

    #[test]
    fn who_is_held_has_none_until_released() {
        let mut turns = RoundRobin::default();
        turns.enqueue(1);
        turns.enqueue(2);
        turns.hold(1);
        turns.enqueue(1);
        turns.withdraw(1);
        turns.enqueue(1);
        assert_eq!(all(&mut turns), [2]);
        turns.release(1);
        assert!(turns.is_empty(), "it must join");
        turns.enqueue(1);
        turns.release(1);
        assert_eq!(all(&mut turns), [1], "what is not held needs no release");
        turns.hold(1);
        turns.forget(1);
        turns.enqueue(1);
        assert_eq!(all(&mut turns), [1]);
    }

    #[test]
    fn whose_time_has_not_come_waits() {
        let (now, second) = (Instant::now(), Duration::from_secs(1));
        let mut turns = RoundRobin::default();
        turns.enqueue_at(1, now + 2 * second, now);
        turns.enqueue_at(2, now + second, now);
        turns.enqueue_at(2, now, now);
        turns.enqueue_at(3, now, now);
        assert_eq!(turns.next_due(), Some(now + second));
        turns.wake_due(now);
        assert_eq!(all(&mut turns), [3]);
        turns.withdraw(2);
        turns.enqueue(2);
        assert_eq!(all(&mut turns), [2]);
        turns.wake_due(now + 2 * second);
        assert_eq!((all(&mut turns), turns.next_due()), (vec![1], None));
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        /// For any sequence of operations: a waiting queue is served once, and none is served twice before the others
        /// that waited with it.
        #[test]
        fn nobody_is_passed_over(steps in prop::collection::vec((0u32..6, 0..5), 0..100)) {
            let mut turns = RoundRobin::default();
            let (mut waiting, mut held) = (Vec::new(), BTreeSet::new());
            for (key, step) in steps {
                match step {
                    0 | 1 => {
                        turns.enqueue(key);
                        if !waiting.contains(&key) && !held.contains(&key) {
                            waiting.push(key);
                        }
                    }
                    2 => {
                        let first = (!waiting.is_empty()).then(|| waiting.remove(0));
                        prop_assert_eq!(turns.take(|_| true), first);
                    }
                    3 => {
                        turns.hold(key);
                        held.insert(key);
                        waiting.retain(|other| *other != key);
                    }
                    _ => {
                        turns.release(key);
                        held.remove(&key);
                    }
                }
            }
            prop_assert_eq!(all(&mut turns), waiting);
        }
    }
}
