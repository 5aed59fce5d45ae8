//! What waits for one client on one topic: newest wins, bounded in messages and bytes, no faster than asked for.

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use ros::bus::PeerId;
use rosbridge::{Compression, Id};

use crate::sample::Sample;

/// Latching publishers remembered.
const MAX_MET: usize = 1024;

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

/// Bounds that the operator sets.
#[derive(Debug, Clone, Copy)]
pub(crate) struct QueueLimits {
    pub(crate) messages: usize,
    pub(crate) bytes: usize,
}

/// What became of a sample that was pushed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Pushed {
    /// Left out because of the throttle rate.
    pub(crate) throttled: bool,
    /// Samples dropped to make room, and their bytes.
    pub(crate) dropped: u64,
    pub(crate) dropped_bytes: usize,
}

struct Waiting {
    sample: Arc<Sample>,
    /// No throttle rate holds it back: what a latching publisher last said, for a newcomer.
    first: bool,
}

/// The queue.
pub(crate) struct TopicQueue {
    /// The topic as the client wrote it.
    pub(crate) topic: Arc<str>,
    pub(crate) wishes: Wishes,
    limits: QueueLimits,
    samples: VecDeque<Waiting>,
    /// Latching publishers whose first message has been queued.
    met: HashSet<PeerId>,
    pub(crate) bytes: usize,
    /// Of those, bytes of samples that count for the daemon by themselves.
    pub(crate) big: usize,
    /// When the throttle rate lets the next one through.
    next_at: Option<Instant>,
    /// When something was last said about messages that cannot be sent.
    pub(crate) complained: Option<Instant>,
    /// In the ring of topics that have something to send, or among those that will.
    pub(crate) scheduled: bool,
    /// A message is being sent in fragments; the next waits.
    pub(crate) busy: bool,
}

impl TopicQueue {
    pub(crate) fn new(topic: Arc<str>, wishes: Wishes, limits: QueueLimits) -> Self {
        Self {
            topic,
            wishes,
            limits,
            samples: VecDeque::new(),
            met: HashSet::new(),
            bytes: 0,
            big: 0,
            next_at: None,
            complained: None,
            scheduled: false,
            busy: false,
        }
    }

    pub(crate) fn has_one(&self) -> bool {
        self.samples.len() <= 1
    }

    /// Queues a sample. `replay`: it is an old one for a newcomer.
    pub(crate) fn push(&mut self, sample: Arc<Sample>, replay: bool, now: Instant) -> Pushed {
        let first = self.is_first(&sample, replay);
        let throttles = !self.wishes.throttle_rate.is_zero() && self.wishes.queue_length == 0;
        if throttles && !first {
            if self.next_at.is_some_and(|at| now < at) {
                return Pushed {
                    throttled: true,
                    ..Pushed::default()
                };
            }
            self.next_at = now.checked_add(self.wishes.throttle_rate);
        }
        self.bytes += sample.bytes.len();
        self.big += sample.big();
        if first {
            let at = self
                .samples
                .iter()
                .take_while(|waiting| waiting.first)
                .count();
            self.samples.insert(at, Waiting { sample, first });
        } else {
            self.samples.push_back(Waiting { sample, first });
        }
        let mut pushed = Pushed::default();
        while self.is_over() {
            let Some(lost) = self.drop_one() else { break };
            pushed.dropped += 1;
            pushed.dropped_bytes += lost;
        }
        pushed
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
        if self.bytes > self.limits.bytes && self.samples.len() > 1 {
            return true;
        }
        // What latching publishers said first does not count: it may never come again.
        let firsts = self
            .samples
            .iter()
            .take_while(|waiting| waiting.first)
            .count();
        let asked = match self.wishes.queue_length {
            0 => self.limits.messages,
            length => length.min(self.limits.messages),
        };
        self.samples.len() - firsts > asked || self.samples.len() > self.limits.messages
    }

    /// Drops the oldest sample that can be spared; gives its size.
    pub(crate) fn drop_one(&mut self) -> Option<usize> {
        let spare = (0..self.samples.len()).find(|&at| {
            let sample = &self.samples[at].sample;
            let newer = |later: &Waiting| later.sample.publisher == sample.publisher;
            !sample.latching || self.samples.range(at + 1..).any(newer)
        });
        let lost = self.samples.remove(spare.unwrap_or(0))?.sample;
        self.bytes -= lost.bytes.len();
        self.big -= lost.big();
        Some(lost.bytes.len())
    }

    /// When the next sample may be sent; `None` while there is none.
    pub(crate) fn due(&self, now: Instant) -> Option<Instant> {
        let next = self.samples.front().filter(|_| !self.busy)?;
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
        let Waiting { sample, first } = self.samples.pop_front()?;
        self.bytes -= sample.bytes.len();
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
