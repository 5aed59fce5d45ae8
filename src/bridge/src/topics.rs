//! Queues of all topics of one client, and the choice of the next one.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

use ros::ring::DropTally;
use ros::turns::RoundRobin;

use crate::sample::TopicSample;
use crate::topic_queue::{QueuedBytes, TopicQueue};

/// Key of a topic of one client.
pub(crate) type TopicKey = u64;

/// Queues of a client's topics.
#[derive(Default)]
pub(crate) struct TopicQueues {
    queues: HashMap<TopicKey, TopicQueue>,
    next_key: TopicKey,
    turns: RoundRobin<TopicKey>,
    load: QueuedBytes,
}

impl TopicQueues {
    pub(crate) fn add(&mut self, queue: TopicQueue) -> TopicKey {
        self.next_key += 1;
        self.queues.insert(self.next_key, queue);
        self.next_key
    }

    /// Updates a topic, if it still exists.
    pub(crate) fn update<R>(&mut self, key: TopicKey, change: impl FnOnce(&mut TopicQueue) -> R) -> Option<R> {
        let queue = self.queues.get_mut(&key)?;
        let before = queue.load();
        let result = change(queue);
        self.load.replace(before, queue.load());
        Some(result)
    }

    pub(crate) fn remove(&mut self, key: TopicKey) {
        if let Some(queue) = self.queues.remove(&key) {
            self.load.replace(queue.load(), QueuedBytes::default());
            self.turns.forget(key);
        }
    }

    /// Returns the sum over all topics.
    pub(crate) fn load(&self) -> QueuedBytes {
        self.load
    }

    /// Gives a topic a turn if a message is queued there.
    pub(crate) fn schedule(&mut self, key: TopicKey, now: Instant) {
        let queue = self.queues.get(&key);
        if let Some(due) = queue.and_then(|queue| queue.due(now)) {
            self.turns.enqueue_at(key, due, now);
        }
    }

    /// Gives a topic a new turn, since it may be due at another time than before.
    pub(crate) fn reschedule(&mut self, key: TopicKey, now: Instant) {
        self.turns.withdraw(key);
        self.schedule(key, now);
    }

    /// Gives the topic no turn until it is [released](Self::release).
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

    /// Returns the next sample of the topic whose turn it is.
    pub(crate) fn next(&mut self, now: Instant) -> Option<(TopicKey, Arc<TopicSample>, &TopicQueue)> {
        self.turns.wake_due(now);
        loop {
            let key = self.turns.take(|_| true)?;
            if let Some(Some(sample)) = self.update(key, |queue| queue.pop(now)) {
                self.schedule(key, now);
                return Some((key, sample, self.queues.get(&key)?));
            }
        }
    }

    /// Returns when a throttle rate lets the next queued message through.
    pub(crate) fn next_due(&self) -> Option<Instant> {
        self.turns.next_due()
    }

    /// Drops a sample of the topic that holds most while there are more than `limit` bytes in all. The only message of
    /// a topic is kept up to four times that: a map larger than the limit must get through, too.
    pub(crate) fn drop_over_limit(&mut self, limit: usize) -> Option<DropTally> {
        let all = self.load.bytes;
        if all <= limit {
            return None;
        }
        let bytes = self.queues.values().map(|queue| queue.load().bytes);
        let spare_only = all <= limit.saturating_mul(4) || Some(all) == bytes.max();
        self.drop_largest(|queue| !(spare_only && queue.has_at_most_one()))
    }

    /// Drops a sample of the topic that holds most, among those that `may` lose one.
    pub(crate) fn drop_largest(&mut self, may: impl Fn(&TopicQueue) -> bool) -> Option<DropTally> {
        let candidates = self.queues.iter().filter(|(_, queue)| may(queue));
        let (key, _) = candidates.max_by_key(|(_, queue)| queue.load().bytes)?;
        self.update(*key, TopicQueue::drop_one)?
    }
}
