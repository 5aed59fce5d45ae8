//! What waits for one client on all of its topics, and which of them is next.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

use ros::ring::Lost;
use ros::turns::Turns;

use crate::sample::Sample;
use crate::topic_queue::{Load, TopicQueue};

/// Names one topic of one client.
pub(crate) type TopicKey = u64;

/// The topics.
#[derive(Default)]
pub(crate) struct Topics {
    queues: HashMap<TopicKey, TopicQueue>,
    next_key: TopicKey,
    turns: Turns<TopicKey>,
    load: Load,
}

impl Topics {
    pub(crate) fn add(&mut self, queue: TopicQueue) -> TopicKey {
        self.next_key += 1;
        self.queues.insert(self.next_key, queue);
        self.next_key
    }

    /// Changes a topic, if it is still there.
    pub(crate) fn change<R>(
        &mut self,
        key: TopicKey,
        change: impl FnOnce(&mut TopicQueue) -> R,
    ) -> Option<R> {
        let queue = self.queues.get_mut(&key)?;
        let before = queue.load();
        let result = change(queue);
        self.load.replace(before, queue.load());
        Some(result)
    }

    pub(crate) fn remove(&mut self, key: TopicKey) {
        if let Some(queue) = self.queues.remove(&key) {
            self.load.replace(queue.load(), Load::default());
            self.turns.forget(key);
        }
    }

    /// Of all topics.
    pub(crate) fn load(&self) -> Load {
        self.load
    }

    /// Gives a topic a turn if something waits there.
    pub(crate) fn schedule(&mut self, key: TopicKey, now: Instant) {
        let queue = self.queues.get(&key);
        if let Some(due) = queue.and_then(|queue| queue.due(now)) {
            self.turns.join_at(key, due, now);
        }
    }

    /// The same, where it may be due at another time than before.
    pub(crate) fn reschedule(&mut self, key: TopicKey, now: Instant) {
        self.turns.withdraw(key);
        self.schedule(key, now);
    }

    /// Gives the topic no turn before it is [released](Self::release).
    pub(crate) fn hold(&mut self, key: TopicKey) {
        if self.queues.contains_key(&key) {
            self.turns.hold(key);
        }
    }

    pub(crate) fn release(&mut self, key: TopicKey, now: Instant) {
        self.turns.release(key);
        self.schedule(key, now);
    }

    pub(crate) fn release_all(&mut self, now: Instant) {
        let keys: Vec<TopicKey> = self.queues.keys().copied().collect();
        for key in keys {
            self.release(key, now);
        }
    }

    /// The next sample of the topic whose turn it is.
    pub(crate) fn next(&mut self, now: Instant) -> Option<(TopicKey, Arc<Sample>, &TopicQueue)> {
        self.turns.wake(now);
        loop {
            let key = self.turns.take(|_| true)?;
            if let Some(Some(sample)) = self.change(key, |queue| queue.pop(now)) {
                self.schedule(key, now);
                return Some((key, sample, self.queues.get(&key)?));
            }
        }
    }

    /// When a throttle rate lets something through that now waits.
    pub(crate) fn next_due(&self) -> Option<Instant> {
        self.turns.next_due()
    }

    /// Drops a sample of the topic that holds most while there is more than `limit` bytes in all. A topic's only message
    /// is spared up to four times that: a map larger than the limit must get through, too.
    pub(crate) fn give_way(&mut self, limit: usize) -> Option<Lost> {
        let all = self.load.bytes;
        if all <= limit {
            return None;
        }
        let bytes = self.queues.values().map(|queue| queue.load().bytes);
        let spare_only = all <= limit.saturating_mul(4) || Some(all) == bytes.max();
        self.drop_largest(|queue| !(spare_only && queue.has_one()))
    }

    /// Drops a sample of the topic that holds most, of those that `may` lose one.
    pub(crate) fn drop_largest(&mut self, may: impl Fn(&TopicQueue) -> bool) -> Option<Lost> {
        let candidates = self.queues.iter().filter(|(_, queue)| may(queue));
        let (key, _) = candidates.max_by_key(|(_, queue)| queue.load().bytes)?;
        self.change(*key, TopicQueue::drop_one)?
    }
}
