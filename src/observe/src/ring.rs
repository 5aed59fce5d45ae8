//! Ring buffer of the messages of the last seconds, oldest first.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use bytes::Bytes;
use ros::bus::PeerId;

/// Estimated overhead of a stored message in bytes.
pub(crate) const MESSAGE_OVERHEAD: usize = 256;
/// Limit on the latched messages kept; beyond it, the oldest are dropped.
const MAX_LATCHED: usize = 1000;
/// Capacity in messages that is never shrunk.
const MIN_CAPACITY: usize = 64;

/// A stored message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredMessage {
    /// Id of the topic.
    pub topic: u32,
    /// Time of arrival in nanoseconds since 1970.
    pub time: u64,
    /// Serialized message.
    pub bytes: Bytes,
}

impl StoredMessage {
    /// Returns the memory used in bytes.
    fn footprint(&self) -> usize {
        self.bytes.len().saturating_add(MESSAGE_OVERHEAD)
    }
}

/// Limits of the ring.
#[derive(Debug, Clone, Copy)]
pub struct RetentionBounds {
    /// Maximum age of a message.
    pub span: Duration,
    /// Maximum size of all messages in bytes, overhead included; beyond it, the topic that uses most loses its
    /// oldest.
    pub bytes: usize,
}

/// Ring buffer of a servant's messages, by topic.
#[derive(Debug)]
pub struct Ring {
    bounds: RetentionBounds,
    topics: BTreeMap<u32, TopicRing>,
    /// Size of all topics in bytes.
    bytes: usize,
    latched: LatchedMessages,
    /// Number of messages too large to be stored.
    pub left_out: u64,
}

/// Messages of one topic, oldest first.
#[derive(Debug, Default)]
struct TopicRing {
    kept: VecDeque<StoredMessage>,
    bytes: usize,
}

impl TopicRing {
    /// Drops the oldest message and returns the bytes freed.
    fn pop_oldest(&mut self) -> usize {
        let gone = self.kept.pop_front().map_or(0, |oldest| oldest.footprint());
        self.bytes -= gone;
        // Shrinks the capacity again, because topics take turns in needing it.
        let used = self.kept.len();
        if self.kept.capacity() > MIN_CAPACITY && used < self.kept.capacity() / 4 {
            self.kept.shrink_to(used * 2);
        }
        gone
    }
}

/// Last message of each latching publisher, as a new subscriber would receive it: the state in which the other
/// messages occurred. It is counted separately, even while the ring also holds it, and remains when the ring drops
/// it.
#[derive(Debug, Default)]
struct LatchedMessages {
    all: BTreeMap<(u32, PeerId), StoredMessage>,
    bytes: usize,
}

impl LatchedMessages {
    fn footprint(publisher: &PeerId, one: &StoredMessage) -> usize {
        one.footprint().saturating_add(publisher.node().len())
    }

    fn insert(&mut self, publisher: PeerId, message: StoredMessage) {
        self.bytes += Self::footprint(&publisher, &message);
        let key = (message.topic, publisher);
        if let Some(before) = self.all.get(&key) {
            self.bytes -= Self::footprint(&key.1, before);
        }
        self.all.insert(key, message);
        if self.all.len() > MAX_LATCHED {
            self.pop_oldest();
        }
    }

    /// Drops the oldest message.
    fn pop_oldest(&mut self) {
        let oldest = self.all.iter().min_by_key(|(_, one)| one.time);
        let Some((key, one)) = oldest else {
            return;
        };
        self.bytes -= Self::footprint(&key.1, one);
        let key = key.clone();
        self.all.remove(&key);
    }

    /// Drops the messages of a topic.
    fn forget_topic(&mut self, topic: u32) {
        let bytes = &mut self.bytes;
        self.all.retain(|(of, publisher), one| {
            let stays = *of != topic;
            if !stays {
                *bytes -= Self::footprint(publisher, one);
            }
            stays
        });
    }
}

impl Ring {
    /// Creates an empty ring.
    pub fn new(bounds: RetentionBounds) -> Self {
        Self { bounds, topics: BTreeMap::new(), bytes: 0, latched: LatchedMessages::default(), left_out: 0 }
    }

    /// Adds a message. `latched_by` is its publisher if that latches.
    pub fn push(&mut self, message: StoredMessage, latched_by: Option<PeerId>) {
        let now = message.time;
        let size = message.footprint();
        if size > self.bounds.bytes {
            self.left_out += 1;
        } else {
            if let Some(publisher) = latched_by {
                self.latched.insert(publisher, message.clone());
            }
            let topic = self.topics.entry(message.topic).or_default();
            topic.bytes += size;
            topic.kept.push_back(message);
            self.bytes += size;
        }
        self.evict(now);
    }

    /// Drops messages that have expired at `now`, then those beyond the size limit: images before the poses that
    /// explain them, and latched messages last.
    pub fn evict(&mut self, now: u64) {
        let span = u64::try_from(self.bounds.span.as_nanos()).unwrap_or(u64::MAX);
        let oldest = now.saturating_sub(span);
        for topic in self.topics.values_mut() {
            while topic.kept.front().is_some_and(|first| first.time < oldest) {
                self.bytes -= topic.pop_oldest();
            }
        }
        while self.bytes + self.latched.bytes > self.bounds.bytes {
            let most = self.topics.values_mut().max_by_key(|topic| topic.bytes);
            match most.filter(|most| most.bytes > 0) {
                Some(most) => self.bytes -= most.pop_oldest(),
                None => self.latched.pop_oldest(),
            }
        }
        self.topics.retain(|_, topic| !topic.kept.is_empty());
    }

    /// Returns the messages at `now`, sorted by time: first the latched ones that the ring no longer holds, then
    /// those of the ring.
    pub fn snapshot(&mut self, now: u64) -> (Vec<StoredMessage>, Vec<StoredMessage>) {
        self.evict(now);
        let is_there = |one: &StoredMessage| {
            let topic = self.topics.get(&one.topic);
            let first = topic.and_then(|topic| topic.kept.front());
            first.is_some_and(|first| first.time <= one.time)
        };
        let before = self.latched.all.values().filter(|one| !is_there(one));
        let mut before: Vec<StoredMessage> = before.cloned().collect();
        before.sort_by_key(|one| one.time);
        let kept = self.topics.values().flat_map(|topic| &topic.kept);
        let mut kept: Vec<StoredMessage> = kept.cloned().collect();
        kept.sort_by_key(|one| one.time);
        (before, kept)
    }

    /// Drops the latched messages of a topic that has ended.
    pub fn forget_latched(&mut self, topic: u32) {
        self.latched.forget_topic(topic);
    }

    /// Returns true if any message of the topic is stored.
    pub fn has_topic(&self, topic: u32) -> bool {
        let all = &self.latched.all;
        self.topics.contains_key(&topic) || all.keys().any(|(of, _)| *of == topic)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: u64 = 1_000_000_000;

    fn stored_message(topic: u32, second: u64, size: usize) -> StoredMessage {
        StoredMessage { topic, time: second * SECOND, bytes: vec![0; size].into() }
    }

    fn ring(seconds: u64, bytes: usize) -> Ring {
        Ring::new(RetentionBounds { span: Duration::from_secs(seconds), bytes })
    }

    fn times(ring: &mut Ring, now: u64) -> Vec<u64> {
        let (before, kept) = ring.snapshot(now * SECOND);
        let all = before.iter().chain(&kept);
        all.map(|one| one.time / SECOND).collect()
    }

    #[test]
    fn what_is_older_goes_and_what_is_too_much() {
        let mut young = ring(10, 20 * (1 + MESSAGE_OVERHEAD));
        (1..=20).for_each(|second| young.push(stored_message(0, second, 1), None));
        assert_eq!(times(&mut young, 20), (10..=20).collect::<Vec<_>>());
        assert_eq!(times(&mut young, 25), (15..=20).collect::<Vec<_>>());
        let mut small = ring(100, 2 * (10 + MESSAGE_OVERHEAD) + 5);
        (1..=20).for_each(|second| small.push(stored_message(0, second, 10), None));
        assert_eq!(times(&mut small, 20), [19, 20]);
        small.push(stored_message(0, 21, 2 * (10 + MESSAGE_OVERHEAD) + 6 - MESSAGE_OVERHEAD), None);
        assert_eq!((times(&mut small, 21), small.left_out), (vec![19, 20], 1));
    }

    #[test]
    fn what_is_large_goes_before_what_is_small() {
        let mut ring = ring(100, 20 * (1 + MESSAGE_OVERHEAD) + 2 * (10_000 + MESSAGE_OVERHEAD));
        for second in 1..=20 {
            ring.push(stored_message(0, second, 10_000), None);
            ring.push(stored_message(1, second, 1), None);
        }
        let (_, all) = ring.snapshot(20 * SECOND);
        let of = |topic| all.iter().filter(|one| one.topic == topic).count();
        assert_eq!((of(0), of(1)), (2, 20));
    }

    #[test]
    fn what_was_latched_before_is_there_once_for_each_publisher() {
        let mut ring = ring(10, 100 * MESSAGE_OVERHEAD);
        let publisher = |name: &str| Some(PeerId::from(name));
        ring.push(stored_message(0, 1, 1), publisher("/a"));
        ring.push(stored_message(0, 2, 1), publisher("/b"));
        ring.push(stored_message(0, 3, 1), publisher("/a"));
        ring.push(stored_message(1, 50, 1), None);
        assert_eq!(times(&mut ring, 50), [2, 3, 50]);
        ring.forget_latched(0);
        assert_eq!(times(&mut ring, 50), [50]);
    }

    #[test]
    fn empty_messages_take_room_too() {
        let mut ring = ring(100, 10 * MESSAGE_OVERHEAD);
        (1..=50).for_each(|second| ring.push(stored_message(0, second, 0), None));
        assert_eq!(times(&mut ring, 50), (41..=50).collect::<Vec<_>>());
    }

    #[test]
    fn topics_that_take_turns_keep_no_room() {
        let mut ring = ring(100, 1000 * MESSAGE_OVERHEAD);
        for topic in 0..20 {
            (0..1000).for_each(|_| ring.push(stored_message(topic, 1, 0), None));
        }
        let all = ring.topics.values();
        let room: usize = all.map(|topic| topic.kept.capacity()).sum();
        assert!(room < 20 * 1000 / 4, "room for {room} messages");
        ring.evict(200 * SECOND);
        assert!(ring.topics.is_empty());
    }

    #[test]
    fn what_is_latched_counts_and_is_bounded() {
        let publisher = |number: usize| Some(PeerId::new("/a", number as u128));
        // Limited by bytes: the newest remain.
        let mut small = ring(10, 10 * (100 + MESSAGE_OVERHEAD + 2));
        (0..50).for_each(|number| small.push(stored_message(0, number as u64, 100), publisher(number)));
        // Much later, only the latched messages remain.
        assert_eq!(times(&mut small, 1000), (40..50).collect::<Vec<_>>());
        assert_eq!(small.latched.bytes, 10 * (100 + MESSAGE_OVERHEAD + 2));
        // A later message of the same publisher replaces the earlier one.
        small.push(stored_message(0, 1001, 100), publisher(49));
        assert_eq!(small.latched.bytes, 10 * (100 + MESSAGE_OVERHEAD + 2));
        // Limited by their number.
        let mut large = ring(10, usize::MAX / 2);
        (0..MAX_LATCHED + 5).for_each(|number| large.push(stored_message(0, number as u64, 0), publisher(number)));
        assert_eq!(large.latched.all.len(), MAX_LATCHED);
        assert_eq!(times(&mut large, 100_000).first(), Some(&5));
        assert!(large.has_topic(0));
        large.forget_latched(0);
        assert_eq!((large.latched.bytes, large.has_topic(0)), (0, false));
    }
}
