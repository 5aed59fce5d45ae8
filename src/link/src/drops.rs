//! Counts of dropped messages by topic and cause: bounded queues drop what they must, but never silently.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

use parking_lot::Mutex;
use ros::ring::DropCount;
use serde::{Deserialize, Serialize};

/// Reason why a message was dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Cause {
    /// Replaced by a newer message.
    Replaced,
    /// Older than T_max while a newer message was waiting.
    Stale,
    /// The message was too big for the retransmit buffer, and in flight when a connection was lost.
    CutOff,
    /// The queue in front of the link was full.
    Busy,
    /// The queue in front of a subscriber was full.
    Slow,
    /// The queue of messages waiting for a node to connect was full.
    Early,
    /// The queue of messages that must not be replaced was full.
    Full,
    /// The publisher had gone before the message was sent.
    Gone,
    /// An encoded frame refers to one that was not received.
    Undecodable,
    /// The other ROS cannot represent it.
    Untranslated,
    /// A cause introduced by a later version.
    #[serde(other)]
    Other,
}

impl Cause {
    /// Returns whether the drop is intended: newest wins, and nothing is older than T_max.
    pub fn is_intended(self) -> bool {
        matches!(self, Self::Replaced | Self::Stale)
    }

    fn description(self) -> &'static str {
        match self {
            Self::Replaced => "newer ones replaced them before the link could send them",
            Self::Stale => "they were older than T_max and a newer one waited",
            Self::CutOff => "they were in transit when a connection was lost",
            Self::Busy => "they arrived faster than this end of the link accepts them",
            Self::Slow => "the subscriber is too slow",
            Self::Early => "the node had not connected to the topic yet",
            Self::Full => "more latched messages and goals waited for the link than fit into its queue (64 MB)",
            Self::Gone => "their publisher was gone before they could be sent",
            Self::Undecodable => "they were encoded relative to a message that was lost",
            Self::Untranslated => "they cannot be carried to the other ROS",
            Self::Other => "for a reason that this version does not know",
        }
    }
}

/// Number of messages of a topic dropped for one cause.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TopicDropCount {
    /// Name of the topic.
    pub topic: String,
    /// Cause of the drops.
    pub cause: Cause,
    /// Total number so far.
    pub count: u64,
}

impl fmt::Display for TopicDropCount {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (topic, words) = (&self.topic, self.cause.description());
        match self.count {
            1 => write!(formatter, "1 message of {topic} was dropped: {words}"),
            count => write!(formatter, "{count} messages of {topic} were dropped: {words}"),
        }
    }
}

/// An external counter.
struct WatchedCounter {
    topic: String,
    cause: Cause,
    seen: u64,
    /// Returns its value and whether it is final.
    counter: Box<dyn Fn() -> (u64, bool) + Send + Sync>,
}

/// Number of dropped messages by key `K` (a topic or a channel) and cause.
#[derive(Debug, Clone, Default)]
pub(crate) struct Tally<K>(BTreeMap<K, BTreeMap<Cause, u64>>);

impl<K: Ord> Tally<K> {
    pub(crate) fn add(&mut self, of: K, cause: Cause, count: u64) {
        if count > 0 {
            *self.0.entry(of).or_default().entry(cause).or_default() += count;
        }
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = (&K, Cause, u64)> {
        self.0.iter().flat_map(|(of, counts)| counts.iter().map(move |(cause, count)| (of, *cause, *count)))
    }

    /// Removes the counts of a key and returns them.
    pub(crate) fn take(&mut self, of: &K) -> BTreeMap<Cause, u64> {
        self.0.remove(of).unwrap_or_default()
    }
}

impl Tally<String> {
    /// Returns the counts by topic.
    pub(crate) fn per_topic(&self) -> Vec<TopicDropCount> {
        let all = self.iter().map(|(topic, cause, count)| TopicDropCount { topic: topic.clone(), cause, count });
        all.collect()
    }
}

/// All drop counts of one end of a link.
#[derive(Default)]
pub struct DropCounters {
    counts: Mutex<Tally<String>>,
    watched: Mutex<Vec<WatchedCounter>>,
}

impl DropCounters {
    /// Adds dropped messages of a topic.
    pub fn add(&self, topic: &str, cause: Cause, count: u64) {
        self.counts.lock().add(topic.to_owned(), cause, count);
    }

    /// Includes the value of an external counter until its owner drops it.
    pub fn watch(&self, topic: &str, cause: Cause, counter: Arc<DropCount>) {
        self.watch_with(topic, cause, move || {
            let owned = Arc::strong_count(&counter) > 1;
            (counter.get(), !owned)
        });
    }

    /// Includes the value returned by `counter` until it reports that its value is final.
    pub fn watch_with(&self, topic: &str, cause: Cause, counter: impl Fn() -> (u64, bool) + Send + Sync + 'static) {
        let (topic, counter) = (topic.to_owned(), Box::new(counter));
        self.watched.lock().push(WatchedCounter { topic, cause, seen: 0, counter });
    }

    /// Returns all counts so far.
    pub fn snapshot(&self) -> Vec<TopicDropCount> {
        self.watched.lock().retain_mut(|watched| {
            let (count, over) = (watched.counter)();
            self.add(&watched.topic, watched.cause, count.saturating_sub(watched.seen));
            watched.seen = count.max(watched.seen);
            !over
        });
        self.counts.lock().per_topic()
    }
}

/// Selects the drops worth reporting: new ones, and those that have grown tenfold since they were last reported.
#[derive(Debug, Default)]
pub struct DropReporter {
    told: BTreeMap<(String, Cause), u64>,
}

impl DropReporter {
    /// Returns the drops to report now and marks them as reported.
    pub fn take_new(&mut self, all: &[TopicDropCount]) -> Vec<TopicDropCount> {
        let mut is_new = |drop: &TopicDropCount| {
            let told = self.told.entry((drop.topic.clone(), drop.cause)).or_default();
            let is_new = drop.count >= told.saturating_mul(10).max(1);
            *told = if is_new { drop.count } else { *told };
            is_new
        };
        all.iter().filter(|drop| is_new(drop)).cloned().collect()
    }
}

#[cfg(test)]
mod tests {
    use ros::ring::DropTally;

    use super::*;

    #[test]
    fn drops_are_counted_forever_and_reported_when_they_grow_tenfold() {
        let (drops, mut reporter) = (DropCounters::default(), DropReporter::default());
        let counter = Arc::new(DropCount::default());
        let lost = |messages| DropTally { messages, bytes: 0 };
        counter.add(lost(2));
        drops.watch("/scan", Cause::Busy, counter.clone());
        drops.add("/image", Cause::Replaced, 1);
        let told: Vec<String> = reporter.take_new(&drops.snapshot()).iter().map(TopicDropCount::to_string).collect();
        assert_eq!(
            told,
            [
                "1 message of /image was dropped: newer ones replaced them before the link could send them",
                "2 messages of /scan were dropped: they arrived faster than this end of the link accepts them",
            ]
        );
        drops.add("/image", Cause::Replaced, 8);
        assert!(reporter.take_new(&drops.snapshot()).is_empty(), "9 are few more than 1");
        counter.add(lost(23));
        drop(counter);
        drops.add("/image", Cause::Replaced, 1);
        let told: Vec<u64> = reporter.take_new(&drops.snapshot()).iter().map(|drop| drop.count).collect();
        assert_eq!(told, [10, 25]);
        // The owner of the counter is gone, but its count remains.
        assert_eq!(drops.snapshot()[1].count, 25);
        assert!(drops.watched.lock().is_empty());
    }

    #[test]
    fn unknown_causes_of_later_versions_are_other() {
        let later = r#"{"topic": "/a", "cause": "eaten", "count": 1}"#;
        let drop: TopicDropCount = serde_json::from_str(later).unwrap();
        assert_eq!(drop.cause, Cause::Other);
    }
}
