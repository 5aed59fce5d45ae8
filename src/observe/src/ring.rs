//! Messages of the last seconds, oldest first.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use bytes::Bytes;
use ros::bus::PeerId;

/// A message that is kept.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Kept {
    /// The topic's number.
    pub topic: u16,
    /// When it was heard, nanoseconds since 1970.
    pub time: u64,
    /// Serialized.
    pub bytes: Bytes,
}

/// How much is kept.
#[derive(Debug, Clone, Copy)]
pub struct Bounds {
    /// Messages that are older go.
    pub span: Duration,
    /// Of all messages; beyond, the oldest go of the topic that has most of them.
    pub bytes: usize,
}

/// What is kept.
#[derive(Debug)]
pub struct Ring {
    bounds: Bounds,
    topics: BTreeMap<u16, OfTopic>,
    bytes: usize,
    /// The last of each publisher that latches, which newcomers would be given: it tells of the state that the others happen in.
    latched: BTreeMap<(u16, PeerId), Kept>,
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
    /// Lets go of the oldest; its bytes.
    fn shorten(&mut self) -> usize {
        let gone = self.kept.pop_front().map_or(0, |oldest| oldest.bytes.len());
        self.bytes -= gone;
        gone
    }
}

impl Ring {
    /// An empty one.
    pub fn new(bounds: Bounds) -> Self {
        Self {
            bounds,
            topics: BTreeMap::new(),
            bytes: 0,
            latched: BTreeMap::new(),
            left_out: 0,
        }
    }

    /// Adds a message; `latched_by`: who would give it to newcomers.
    pub fn push(&mut self, message: Kept, latched_by: Option<PeerId>) {
        let now = message.time;
        let size = message.bytes.len();
        if size > self.bounds.bytes {
            self.left_out += 1;
        } else {
            if let Some(publisher) = latched_by {
                let key = (message.topic, publisher);
                self.latched.insert(key, message.clone());
            }
            let topic = self.topics.entry(message.topic).or_default();
            topic.bytes += size;
            topic.kept.push_back(message);
            self.bytes += size;
        }
        self.forget(now);
    }

    /// Lets go of what is too old at `now`, and of what is too much: pictures before the positions that explain them.
    pub fn forget(&mut self, now: u64) {
        let span = u64::try_from(self.bounds.span.as_nanos()).unwrap_or(u64::MAX);
        let oldest = now.saturating_sub(span);
        for topic in self.topics.values_mut() {
            while topic.kept.front().is_some_and(|first| first.time < oldest) {
                self.bytes -= topic.shorten();
            }
        }
        while self.bytes > self.bounds.bytes {
            let most = self.topics.values_mut().max_by_key(|topic| topic.bytes);
            let gone = most.map_or(0, OfTopic::shorten);
            self.bytes -= gone;
        }
    }

    /// All at `now`, by time: what was latched before and is not among the others any more, and these.
    pub fn all(&mut self, now: u64) -> (Vec<Kept>, Vec<Kept>) {
        self.forget(now);
        let is_there = |one: &Kept| {
            let topic = self.topics.get(&one.topic);
            let first = topic.and_then(|topic| topic.kept.front());
            first.is_some_and(|first| first.time <= one.time)
        };
        let before = self.latched.values().filter(|one| !is_there(one));
        let mut before: Vec<Kept> = before.cloned().collect();
        before.sort_by_key(|one| one.time);
        let kept = self.topics.values().flat_map(|topic| &topic.kept);
        let mut kept: Vec<Kept> = kept.cloned().collect();
        kept.sort_by_key(|one| one.time);
        (before, kept)
    }

    /// Forgets what is latched on a topic that is gone.
    pub fn gone(&mut self, topic: u16) {
        self.latched.retain(|(of, _), _| *of != topic);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: u64 = 1_000_000_000;

    fn kept(topic: u16, second: u64, size: usize) -> Kept {
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
        let mut young = ring(10, 1000);
        (1..=20).for_each(|second| young.push(kept(0, second, 1), None));
        assert_eq!(times(&mut young, 20), (10..=20).collect::<Vec<_>>());
        assert_eq!(times(&mut young, 25), (15..=20).collect::<Vec<_>>());
        let mut small = ring(100, 25);
        (1..=20).for_each(|second| small.push(kept(0, second, 10), None));
        assert_eq!(times(&mut small, 20), [19, 20]);
        small.push(kept(0, 21, 26), None);
        assert_eq!((times(&mut small, 21), small.left_out), (vec![19, 20], 1));
    }

    #[test]
    fn what_is_large_goes_before_what_is_small() {
        let mut ring = ring(100, 250);
        for second in 1..=20 {
            ring.push(kept(0, second, 100), None);
            ring.push(kept(1, second, 1), None);
        }
        let (_, all) = ring.all(20 * SECOND);
        let of = |topic| all.iter().filter(|one| one.topic == topic).count();
        assert_eq!((of(0), of(1)), (2, 20));
    }

    #[test]
    fn what_was_latched_before_is_there_once_for_each_publisher() {
        let mut ring = ring(10, 1000);
        let publisher = |name: &str| Some(PeerId::from(name));
        ring.push(kept(0, 1, 1), publisher("/a"));
        ring.push(kept(0, 2, 1), publisher("/b"));
        ring.push(kept(0, 3, 1), publisher("/a"));
        ring.push(kept(1, 50, 1), None);
        assert_eq!(times(&mut ring, 50), [2, 3, 50]);
        ring.gone(0);
        assert_eq!(times(&mut ring, 50), [50]);
    }
}
