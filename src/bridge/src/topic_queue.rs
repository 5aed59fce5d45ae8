//! Messages of one topic queued for one client: the newest are kept, within limits on messages and bytes, and sent no
//! faster than requested.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use ros::bus::PeerId;
use ros::ring::{DropTally, Ring, RingBounds, RingItem};
use rosbridge::{Compression, Id};

use crate::Drops;
use crate::sample::TopicSample;

/// Maximum number of latching publishers remembered.
const MAX_LATCHING_PUBLISHERS: usize = 1024;
/// Maximum number of messages kept however large they are, if a client asked for them: the default of ROS's own queues.
const MOST_LARGE: usize = 10;
/// Default for a client that did not ask: a message that is read while another waits costs nothing, and no client gets
/// older ones.
const LARGE: usize = 2;

/// Options of one `subscribe`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct SubscriptionOptions {
    pub(crate) throttle_rate: Duration,
    pub(crate) queue_length: usize,
    pub(crate) fragment_size: Option<usize>,
    pub(crate) compression: Compression,
}

impl SubscriptionOptions {
    /// Returns the options that satisfy all of a client's subscriptions to a topic: the lowest throttle rate and
    /// fragment size, the longest queue, the most compact encoding.
    pub(crate) fn merge<'w>(all: impl Iterator<Item = &'w SubscriptionOptions>) -> Option<SubscriptionOptions> {
        all.copied().reduce(|one, other| SubscriptionOptions {
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

/// Subscriptions of one client to one topic, by id.
pub(crate) type Subscriptions = HashMap<Option<Id<'static>>, SubscriptionOptions>;

struct QueuedSample {
    sample: Arc<TopicSample>,
    /// True for messages that no throttle rate delays: the last one of a latching publisher, for a new subscriber.
    first: bool,
}

impl RingItem for QueuedSample {
    fn memory_size(&self) -> usize {
        self.sample.bytes.len()
    }
}

/// Bytes of queued samples.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct QueuedBytes {
    pub(crate) bytes: usize,
    /// Bytes of samples among them that count for the daemon by themselves.
    pub(crate) big: usize,
}

impl QueuedBytes {
    /// Replaces a part of the sum.
    pub(crate) fn replace(&mut self, before: QueuedBytes, after: QueuedBytes) {
        self.bytes = self.bytes - before.bytes + after.bytes;
        self.big = self.big - before.big + after.big;
    }
}

/// Queue of one topic.
pub(crate) struct TopicQueue {
    /// Topic as the client wrote it.
    pub(crate) topic: Arc<str>,
    /// Counter of dropped messages.
    drops: Arc<Drops>,
    pub(crate) wishes: SubscriptionOptions,
    limits: RingBounds,
    samples: Ring<QueuedSample>,
    /// Latching publishers whose first message has been queued.
    met: HashSet<PeerId>,
    /// Bytes of samples that count for the daemon by themselves.
    big: usize,
    /// Time at which the throttle rate lets the next message through.
    next_at: Option<Instant>,
    /// Time of the last report on messages that cannot be sent.
    complained: Option<Instant>,
}

impl TopicQueue {
    pub(crate) fn new(topic: Arc<str>, wishes: SubscriptionOptions, limits: RingBounds, drops: Arc<Drops>) -> Self {
        Self {
            topic,
            drops,
            wishes,
            limits,
            samples: Ring::default(),
            met: HashSet::new(),
            big: 0,
            next_at: None,
            complained: None,
        }
    }

    pub(crate) fn has_at_most_one(&self) -> bool {
        self.samples.len() <= 1
    }

    pub(crate) fn load(&self) -> QueuedBytes {
        QueuedBytes { bytes: self.samples.bytes(), big: self.big }
    }

    /// Queues a sample, for which others may be dropped; returns `None` if it is dropped because of the throttle rate.
    /// `replay`: it is an old one for a new subscriber.
    pub(crate) fn push(&mut self, sample: Arc<TopicSample>, replay: bool, now: Instant) -> Option<DropTally> {
        let first = self.is_first(&sample, replay);
        let throttles = !self.wishes.throttle_rate.is_zero() && self.wishes.queue_length == 0;
        if throttles && !first {
            if self.next_at.is_some_and(|at| now < at) {
                return None;
            }
            self.next_at = now.checked_add(self.wishes.throttle_rate);
        }
        self.big += sample.counted_bytes();
        let at = if first { self.first_count() } else { self.samples.len() };
        self.samples.insert(at, QueuedSample { sample, first });
        let mut lost = DropTally::default();
        while self.exceeds_limits() {
            let Some(one) = self.drop_one() else { break };
            lost += one;
        }
        Some(lost)
    }

    /// Returns the number of first messages of latching publishers; they come before all others.
    fn first_count(&self) -> usize {
        let waiting = self.samples.iter();
        waiting.take_while(|waiting| waiting.first).count()
    }

    fn is_first(&mut self, sample: &TopicSample, replay: bool) -> bool {
        if !sample.latching {
            return replay;
        }
        // An endless number of publisher names must not fill the memory.
        if self.met.len() >= MAX_LATCHING_PUBLISHERS {
            self.met.clear();
        }
        self.met.insert(sample.publisher.clone()) || replay
    }

    fn exceeds_limits(&self) -> bool {
        let (asked, large) = match self.wishes.queue_length {
            0 => (self.limits.messages, LARGE),
            length => (length.min(self.limits.messages), length.min(MOST_LARGE)),
        };
        let waiting = self.samples.len();
        // First messages of latching publishers do not count: they may never be repeated.
        waiting > self.limits.messages
            || waiting - self.first_count() > asked
            || (waiting > large && self.samples.bytes() > self.limits.bytes)
    }

    /// Drops the oldest sample that may be dropped.
    pub(crate) fn drop_one(&mut self) -> Option<DropTally> {
        let waiting = self.samples.iter().enumerate();
        let spare = waiting.clone().find(|(at, QueuedSample { sample, .. })| {
            let newer = |(_, later): (_, &QueuedSample)| later.sample.publisher == sample.publisher;
            !sample.latching || waiting.clone().skip(at + 1).any(newer)
        });
        let spare = spare.map_or(0, |(at, _)| at);
        drop(waiting);
        let gone = self.samples.remove(spare)?;
        self.big -= gone.sample.counted_bytes();
        self.drops.add(&self.topic, 1);
        Some(DropTally::from_message(&gone))
    }

    /// Returns whether it is time to report again that its messages cannot be sent.
    pub(crate) fn should_report(&mut self, now: Instant) -> bool {
        let recently = |at| now.saturating_duration_since(at).as_secs() < 5;
        let due = !self.complained.is_some_and(recently);
        if due {
            self.complained = Some(now);
        }
        due
    }

    /// Returns when the next sample may be sent; `None` while there is none.
    pub(crate) fn due(&self, now: Instant) -> Option<Instant> {
        let next = self.samples.front()?;
        let held_back = !next.first && self.wishes.queue_length > 0 && !self.wishes.throttle_rate.is_zero();
        Some(self.next_at.filter(|at| held_back && *at > now).unwrap_or(now))
    }

    /// Takes the next sample to send.
    pub(crate) fn pop(&mut self, now: Instant) -> Option<Arc<TopicSample>> {
        let QueuedSample { sample, first } = self.samples.pop()?;
        self.big -= sample.counted_bytes();
        if self.wishes.queue_length > 0 && !first {
            self.next_at = now.checked_add(self.wishes.throttle_rate);
        }
        Some(sample)
    }
}

#[cfg(test)]
#[path = "topic_queue_tests.rs"]
mod tests;
