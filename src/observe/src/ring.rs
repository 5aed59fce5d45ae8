//! Messages of the last seconds, oldest first.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use bytes::Bytes;
use ros::bus::PeerId;

/// What a message takes beside its bytes, about.
pub(crate) const EACH: usize = 256;
/// Messages that are kept because they are latched; beyond, the oldest go.
const LATCHED: usize = 1000;
/// Room for so few messages is not given back.
const FEW: usize = 64;

/// A message that is kept.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Kept {
    /// The topic's number.
    pub topic: u32,
    /// When it was heard, nanoseconds since 1970.
    pub time: u64,
    /// Serialized.
    pub bytes: Bytes,
}

impl Kept {
    /// Bytes that it takes.
    fn takes(&self) -> usize {
        self.bytes.len().saturating_add(EACH)
    }
}

/// How much is kept.
#[derive(Debug, Clone, Copy)]
pub struct Bounds {
    /// Messages that are older go.
    pub span: Duration,
    /// Of all messages, with what each takes beside its own; beyond, the oldest go of the topic that has most of them.
    pub bytes: usize,
}

/// What is kept.
#[derive(Debug)]
pub struct Ring {
    bounds: Bounds,
    topics: BTreeMap<u32, OfTopic>,
    /// Of all of them.
    bytes: usize,
    latched: Latched,
    /// Messages that were too large to be kept.
    pub left_out: u64,
}

/// Messages of a topic, oldest first.
#[derive(Debug, Default)]
struct OfTopic {
    kept: VecDeque<Kept>,
    bytes: usize,
}

impl OfTopic {
    /// Lets go of the oldest; the bytes that it took.
    fn shorten(&mut self) -> usize {
        let gone = self.kept.pop_front().map_or(0, |oldest| oldest.takes());
        self.bytes -= gone;
        // Room that was once needed is not kept for good: topics take turns.
        let used = self.kept.len();
        if self.kept.capacity() > FEW && used < self.kept.capacity() / 4 {
            self.kept.shrink_to(used * 2);
        }
        gone
    }
}

/// The last of each publisher that latches, which newcomers would be given: it tells of the state that the others happen in. It counts
/// besides, also while it is among the others: it stays when they go.
#[derive(Debug, Default)]
struct Latched {
    all: BTreeMap<(u32, PeerId), Kept>,
    bytes: usize,
}

impl Latched {
    fn takes(publisher: &PeerId, one: &Kept) -> usize {
        one.takes().saturating_add(publisher.node().len())
    }

    fn insert(&mut self, publisher: PeerId, message: Kept) {
        self.bytes += Self::takes(&publisher, &message);
        let key = (message.topic, publisher);
        if let Some(before) = self.all.get(&key) {
            self.bytes -= Self::takes(&key.1, before);
        }
        self.all.insert(key, message);
        if self.all.len() > LATCHED {
            self.shorten();
        }
    }

    /// Lets go of the oldest.
    fn shorten(&mut self) {
        let oldest = self.all.iter().min_by_key(|(_, one)| one.time);
        let Some((key, one)) = oldest else {
            return;
        };
        self.bytes -= Self::takes(&key.1, one);
        let key = key.clone();
        self.all.remove(&key);
    }

    /// Forgets those of a topic.
    fn gone(&mut self, topic: u32) {
        let bytes = &mut self.bytes;
        self.all.retain(|(of, publisher), one| {
            let stays = *of != topic;
            if !stays {
                *bytes -= Self::takes(publisher, one);
            }
            stays
        });
    }
}

impl Ring {
    /// An empty one.
    pub fn new(bounds: Bounds) -> Self {
        Self {
            bounds,
            topics: BTreeMap::new(),
            bytes: 0,
            latched: Latched::default(),
            left_out: 0,
        }
    }

    /// Adds a message; `latched_by`: who would give it to newcomers.
    pub fn push(&mut self, message: Kept, latched_by: Option<PeerId>) {
        let now = message.time;
        let size = message.takes();
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
        self.forget(now);
    }

    /// Lets go of what is too old at `now`, and of what is too much: pictures before the positions that explain them, and last what is
    /// latched.
    pub fn forget(&mut self, now: u64) {
        let span = u64::try_from(self.bounds.span.as_nanos()).unwrap_or(u64::MAX);
        let oldest = now.saturating_sub(span);
        for topic in self.topics.values_mut() {
            while topic.kept.front().is_some_and(|first| first.time < oldest) {
                self.bytes -= topic.shorten();
            }
        }
        while self.bytes + self.latched.bytes > self.bounds.bytes {
            let most = self.topics.values_mut().max_by_key(|topic| topic.bytes);
            match most.filter(|most| most.bytes > 0) {
                Some(most) => self.bytes -= most.shorten(),
                None => self.latched.shorten(),
            }
        }
        self.topics.retain(|_, topic| !topic.kept.is_empty());
    }

    /// All at `now`, by time: what was latched before and is not among the others any more, and these.
    pub fn all(&mut self, now: u64) -> (Vec<Kept>, Vec<Kept>) {
        self.forget(now);
        let is_there = |one: &Kept| {
            let topic = self.topics.get(&one.topic);
            let first = topic.and_then(|topic| topic.kept.front());
            first.is_some_and(|first| first.time <= one.time)
        };
        let before = self.latched.all.values().filter(|one| !is_there(one));
        let mut before: Vec<Kept> = before.cloned().collect();
        before.sort_by_key(|one| one.time);
        let kept = self.topics.values().flat_map(|topic| &topic.kept);
        let mut kept: Vec<Kept> = kept.cloned().collect();
        kept.sort_by_key(|one| one.time);
        (before, kept)
    }

    /// Forgets what is latched on a topic that is gone.
    pub fn gone(&mut self, topic: u32) {
        self.latched.gone(topic);
    }

    /// Whether anything of a topic is kept.
    pub fn has(&self, topic: u32) -> bool {
        let all = &self.latched.all;
        self.topics.contains_key(&topic) || all.keys().any(|(of, _)| *of == topic)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: u64 = 1_000_000_000;

    fn kept(topic: u32, second: u64, size: usize) -> Kept {
        Kept {
            topic,
            time: second * SECOND,
            bytes: vec![0; size].into(),
        }
    }

    fn ring(seconds: u64, bytes: usize) -> Ring {
        Ring::new(Bounds {
            span: Duration::from_secs(seconds),
            bytes,
        })
    }

    fn times(ring: &mut Ring, now: u64) -> Vec<u64> {
        let (before, kept) = ring.all(now * SECOND);
        let all = before.iter().chain(&kept);
        all.map(|one| one.time / SECOND).collect()
    }

    #[test]
    fn what_is_older_goes_and_what_is_too_much() {
        let mut young = ring(10, 20 * (1 + EACH));
        (1..=20).for_each(|second| young.push(kept(0, second, 1), None));
        assert_eq!(times(&mut young, 20), (10..=20).collect::<Vec<_>>());
        assert_eq!(times(&mut young, 25), (15..=20).collect::<Vec<_>>());
        let mut small = ring(100, 2 * (10 + EACH) + 5);
        (1..=20).for_each(|second| small.push(kept(0, second, 10), None));
        assert_eq!(times(&mut small, 20), [19, 20]);
        small.push(kept(0, 21, 2 * (10 + EACH) + 6 - EACH), None);
        assert_eq!((times(&mut small, 21), small.left_out), (vec![19, 20], 1));
    }

    #[test]
    fn what_is_large_goes_before_what_is_small() {
        let mut ring = ring(100, 20 * (1 + EACH) + 2 * (10_000 + EACH));
        for second in 1..=20 {
            ring.push(kept(0, second, 10_000), None);
            ring.push(kept(1, second, 1), None);
        }
        let (_, all) = ring.all(20 * SECOND);
        let of = |topic| all.iter().filter(|one| one.topic == topic).count();
        assert_eq!((of(0), of(1)), (2, 20));
    }

    #[test]
    fn what_was_latched_before_is_there_once_for_each_publisher() {
        let mut ring = ring(10, 100 * EACH);
        let publisher = |name: &str| Some(PeerId::from(name));
        ring.push(kept(0, 1, 1), publisher("/a"));
        ring.push(kept(0, 2, 1), publisher("/b"));
        ring.push(kept(0, 3, 1), publisher("/a"));
        ring.push(kept(1, 50, 1), None);
        assert_eq!(times(&mut ring, 50), [2, 3, 50]);
        ring.gone(0);
        assert_eq!(times(&mut ring, 50), [50]);
    }

    #[test]
    fn empty_messages_take_room_too() {
        let mut ring = ring(100, 10 * EACH);
        (1..=50).for_each(|second| ring.push(kept(0, second, 0), None));
        assert_eq!(times(&mut ring, 50), (41..=50).collect::<Vec<_>>());
    }

    #[test]
    fn topics_that_take_turns_keep_no_room() {
        let mut ring = ring(100, 1000 * EACH);
        for topic in 0..20 {
            (0..1000).for_each(|_| ring.push(kept(topic, 1, 0), None));
        }
        let all = ring.topics.values();
        let room: usize = all.map(|topic| topic.kept.capacity()).sum();
        assert!(room < 20 * 1000 / 4, "room for {room} messages");
        ring.forget(200 * SECOND);
        assert!(ring.topics.is_empty());
    }

    #[test]
    fn what_is_latched_counts_and_is_bounded() {
        let publisher = |number: usize| Some(PeerId::new("/a", number as u128));
        // By its bytes: the newest are there, and nothing beyond the bound.
        let mut small = ring(10, 10 * (100 + EACH + 2));
        (0..50).for_each(|number| small.push(kept(0, number as u64, 100), publisher(number)));
        // Long after, only those that are latched.
        assert_eq!(times(&mut small, 1000), (40..50).collect::<Vec<_>>());
        assert_eq!(small.latched.bytes, 10 * (100 + EACH + 2));
        // A later one of the same publisher takes the place of the earlier.
        small.push(kept(0, 1001, 100), publisher(49));
        assert_eq!(small.latched.bytes, 10 * (100 + EACH + 2));
        // By their number.
        let mut large = ring(10, usize::MAX / 2);
        (0..LATCHED + 5)
            .for_each(|number| large.push(kept(0, number as u64, 0), publisher(number)));
        assert_eq!(large.latched.all.len(), LATCHED);
        assert_eq!(times(&mut large, 100_000).first(), Some(&5));
        assert!(large.has(0));
        large.gone(0);
        assert_eq!((large.latched.bytes, large.has(0)), (0, false));
    }
}
