//! Which of several queues is served next: each that has something has one turn, then goes behind the others.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Instant;

/// Queues, by key, that wait to be served.
#[derive(Debug)]
pub struct Turns<K> {
    ready: VecDeque<K>,
    /// Those whose time has not come, and when it does.
    later: BTreeSet<(Instant, K)>,
    /// Of all queues that are not forgotten: a queue that joins and is served again and again changes nothing here but its place.
    places: BTreeMap<K, QueueState>,
}

#[derive(Debug, Clone, Copy, Default)]
enum QueueState {
    #[default]
    None,
    Ready,
    Later(Instant),
    /// It gets no turn until it is released.
    Held,
}

impl<K> Default for Turns<K> {
    fn default() -> Self {
        Self {
            ready: VecDeque::new(),
            later: BTreeSet::new(),
            places: BTreeMap::new(),
        }
    }
}

impl<K: Copy + Ord> Turns<K> {
    /// This queue has something: it gets a turn after all that wait for theirs, unless it waits already or is held.
    pub fn join(&mut self, key: K) {
        let state = self.places.entry(key).or_default();
        if let QueueState::None = state {
            *state = QueueState::Ready;
            self.ready.push_back(key);
        }
    }

    /// The same, but not before `due`.
    pub fn join_at(&mut self, key: K, due: Instant, now: Instant) {
        if due <= now {
            return self.join(key);
        }
        let state = self.places.entry(key).or_default();
        if let QueueState::None = state {
            *state = QueueState::Later(due);
            self.later.insert((due, key));
        }
    }

    /// Those whose time has come join.
    pub fn wake(&mut self, now: Instant) {
        while let Some((due, key)) = self.later.first().copied().filter(|(due, _)| *due <= now) {
            self.later.remove(&(due, key));
            self.places.insert(key, QueueState::Ready);
            self.ready.push_back(key);
        }
    }

    /// The next of those that `may` be served; if there is more in its queue it has to join again.
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

    /// This queue gets no turn until it is [released](Self::release).
    pub fn hold(&mut self, key: K) {
        self.withdraw(key);
        self.places.insert(key, QueueState::Held);
    }

    /// It may join again.
    pub fn release(&mut self, key: K) {
        if let Some(state @ QueueState::Held) = self.places.get_mut(&key) {
            *state = QueueState::None;
        }
    }

    /// There is nothing in this queue any more. If it is held it stays so.
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

    /// This queue is gone.
    pub fn forget(&mut self, key: K) {
        self.withdraw(key);
        self.places.remove(&key);
    }

    /// Whether none may be served now.
    pub fn is_empty(&self) -> bool {
        self.ready.is_empty()
    }

    /// When the next of those joins whose time has not come.
    pub fn next_due(&self) -> Option<Instant> {
        self.later.first().map(|(due, _)| *due)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use proptest::prelude::*;

    use super::*;

    fn all(turns: &mut Turns<u32>) -> Vec<u32> {
        std::iter::from_fn(|| turns.take(|_| true)).collect()
    }

    #[test]
    fn each_has_one_turn() {
        let mut turns = Turns::default();
        for key in [1, 2, 1, 3, 1] {
            turns.join(key);
        }
        assert_eq!(turns.take(|key| *key != 1), Some(2));
        turns.join(2);
        assert_eq!(all(&mut turns), [1, 3, 2]);
    }

    #[test]
    fn who_is_held_has_none_until_released() {
        let mut turns = Turns::default();
        turns.join(1);
        turns.join(2);
        turns.hold(1);
        turns.join(1);
        turns.withdraw(1);
        turns.join(1);
        assert_eq!(all(&mut turns), [2]);
        turns.release(1);
        assert!(turns.is_empty(), "it must join");
        turns.join(1);
        turns.release(1);
        assert_eq!(all(&mut turns), [1], "what is not held needs no release");
        turns.hold(1);
        turns.forget(1);
        turns.join(1);
        assert_eq!(all(&mut turns), [1]);
    }

    #[test]
    fn whose_time_has_not_come_waits() {
        let (now, second) = (Instant::now(), Duration::from_secs(1));
        let mut turns = Turns::default();
        turns.join_at(1, now + 2 * second, now);
        turns.join_at(2, now + second, now);
        turns.join_at(2, now, now);
        turns.join_at(3, now, now);
        assert_eq!(turns.next_due(), Some(now + second));
        turns.wake(now);
        assert_eq!(all(&mut turns), [3]);
        turns.withdraw(2);
        turns.join(2);
        assert_eq!(all(&mut turns), [2]);
        turns.wake(now + 2 * second);
        assert_eq!((all(&mut turns), turns.next_due()), (vec![1], None));
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        /// Whatever happens: who waits is served once, and nobody twice before all others that waited with it.
        #[test]
        fn nobody_is_passed_over(steps in prop::collection::vec((0u32..6, 0..5), 0..100)) {
            let mut turns = Turns::default();
            let (mut waiting, mut held) = (Vec::new(), BTreeSet::new());
            for (key, step) in steps {
                match step {
                    0 | 1 => {
                        turns.join(key);
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
