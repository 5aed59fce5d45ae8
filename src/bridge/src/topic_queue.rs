//! What waits for one client on one topic: newest wins, bounded in messages and bytes, no faster than asked for.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use ros::bus::PeerId;
use ros::ring::{Bounds, Held, Lost, Ring};
use rosbridge::{Compression, Id};

use crate::Drops;
use crate::sample::Sample;

/// Latching publishers remembered.
const MAX_MET: usize = 1024;
/// So many messages are kept however large they are, where a client asked for that many: as many as ROS's own queues have by default.
const MOST_LARGE: usize = 10;
/// As many for a client that did not say: one that is taken up while another waits costs nothing, and nobody is shown what is older than that.
const LARGE: usize = 2;

/// What one `subscribe` asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Wishes {
    pub(crate) throttle_rate: Duration,
    pub(crate) queue_length: usize,
    pub(crate) fragment_size: Option<usize>,
    pub(crate) compression: Compression,
}

impl Wishes {
    /// What satisfies all of a client's subscriptions to a topic: the lowest rate limit and fragment size, the
    /// longest queue, the most compact encoding.
    pub(crate) fn merged<'w>(all: impl Iterator<Item = &'w Wishes>) -> Option<Wishes> {
        all.copied().reduce(|one, other| Wishes {
            throttle_rate: one.throttle_rate.min(other.throttle_rate),
            queue_length: one.queue_length.max(other.queue_length),
            fragment_size: match (one.fragment_size, other.fragment_size) {
                (Some(one), Some(other)) => Some(one.min(other)),
                (one, other) => one.or(other),
            },
            compression: one.compression.max(other.compression),
        })
    }
}

/// The subscriptions of one client to one topic, by id.
pub(crate) type Subscriptions = HashMap<Option<Id<'static>>, Wishes>;

struct Waiting {
    sample: Arc<Sample>,
    /// No throttle rate holds it back: what a latching publisher last said, for a newcomer.
    first: bool,
}

impl Held for Waiting {
    fn held(&self) -> usize {
        self.sample.bytes.len()
    }
}

/// Bytes of samples that wait.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Load {
    pub(crate) bytes: usize,
    /// Of those, bytes of samples that count for the daemon by themselves.
    pub(crate) big: usize,
}

impl Load {
    /// A part of it has changed.
    pub(crate) fn replace(&mut self, before: Load, after: Load) {
        self.bytes = self.bytes - before.bytes + after.bytes;
        self.big = self.big - before.big + after.big;
    }
}

/// The queue.
pub(crate) struct TopicQueue {
    /// The topic as the client wrote it.
    pub(crate) topic: Arc<str>,
    /// Where what it drops is counted.
    drops: Arc<Drops>,
    pub(crate) wishes: Wishes,
    limits: Bounds,
    samples: Ring<Waiting>,
    /// Latching publishers whose first message has been queued.
    met: HashSet<PeerId>,
    /// Bytes of samples that count for the daemon by themselves.
    big: usize,
    /// When the throttle rate lets the next one through.
    next_at: Option<Instant>,
    /// When something was last said about messages that cannot be sent.
    complained: Option<Instant>,
}

impl TopicQueue {
    pub(crate) fn new(topic: Arc<str>, wishes: Wishes, limits: Bounds, drops: Arc<Drops>) -> Self {
        Self {
            topic,
            drops,
            wishes,
            limits,
            samples: Ring::unbounded(),
            met: HashSet::new(),
            big: 0,
            next_at: None,
            complained: None,
        }
    }

    pub(crate) fn has_one(&self) -> bool {
        self.samples.len() <= 1
    }

    pub(crate) fn load(&self) -> Load {
        Load {
            bytes: self.samples.bytes(),
            big: self.big,
        }
    }

    /// Queues a sample, for which others may be dropped; none if it is left out because of the throttle rate. `replay`:
    /// it is an old one for a newcomer.
    pub(crate) fn push(&mut self, sample: Arc<Sample>, replay: bool, now: Instant) -> Option<Lost> {
        let first = self.is_first(&sample, replay);
        let throttles = !self.wishes.throttle_rate.is_zero() && self.wishes.queue_length == 0;
        if throttles && !first {
            if self.next_at.is_some_and(|at| now < at) {
                return None;
            }
            self.next_at = now.checked_add(self.wishes.throttle_rate);
        }
        self.big += sample.big();
        let at = match first {
            true => self.firsts(),
            false => self.samples.len(),
        };
        self.samples.insert(at, Waiting { sample, first });
        let mut lost = Lost::default();
        while self.is_over() {
            let Some(one) = self.drop_one() else { break };
            lost += one;
        }
        Some(lost)
    }

    /// How many are first messages of latching publishers; they come before all others.
    fn firsts(&self) -> usize {
        let waiting = self.samples.iter();
        waiting.take_while(|waiting| waiting.first).count()
    }

    fn is_first(&mut self, sample: &Sample, replay: bool) -> bool {
        if !sample.latching {
            return replay;
        }
        // Publishers whose names never end must not fill the memory.
        if self.met.len() >= MAX_MET {
            self.met.clear();
        }
        self.met.insert(sample.publisher.clone()) || replay
    }

    fn is_over(&self) -> bool {
        let (asked, large) = match self.wishes.queue_length {
            0 => (self.limits.messages, LARGE),
            length => (length.min(self.limits.messages), length.min(MOST_LARGE)),
        };
        let waiting = self.samples.len();
        // What latching publishers said first does not count: it may never come again.
        waiting > self.limits.messages
            || waiting - self.firsts() > asked
            || (waiting > large && self.samples.bytes() > self.limits.bytes)
    }

    /// Drops the oldest sample that can be spared.
    pub(crate) fn drop_one(&mut self) -> Option<Lost> {
        let waiting = self.samples.iter().enumerate();
        let spare = waiting.clone().find(|(at, Waiting { sample, .. })| {
            let newer = |(_, later): (_, &Waiting)| later.sample.publisher == sample.publisher;
            !sample.latching || waiting.clone().skip(at + 1).any(newer)
        });
        let spare = spare.map_or(0, |(at, _)| at);
        drop(waiting);
        let gone = self.samples.remove(spare)?;
        self.big -= gone.sample.big();
        self.drops.add(&self.topic, 1);
        Some(Lost::one(&gone))
    }

    /// Its messages cannot be sent; gives whether it is time to say so again.
    pub(crate) fn may_complain(&mut self, now: Instant) -> bool {
        let recently = |at| now.saturating_duration_since(at).as_secs() < 5;
        let due = !self.complained.is_some_and(recently);
        if due {
            self.complained = Some(now);
        }
        due
    }

    /// When the next sample may be sent; `None` while there is none.
    pub(crate) fn due(&self, now: Instant) -> Option<Instant> {
        let next = self.samples.front()?;
        let held_back =
            !next.first && self.wishes.queue_length > 0 && !self.wishes.throttle_rate.is_zero();
        Some(
            self.next_at
                .filter(|at| held_back && *at > now)
                .unwrap_or(now),
        )
    }

    /// The next sample to send.
    pub(crate) fn pop(&mut self, now: Instant) -> Option<Arc<Sample>> {
        let Waiting { sample, first } = self.samples.pop()?;
        self.big -= sample.big();
        if self.wishes.queue_length > 0 && !first {
            self.next_at = now.checked_add(self.wishes.throttle_rate);
        }
        Some(sample)
    }
}

#[cfg(test)]
#[path = "topic_queue_tests.rs"]
mod tests;
