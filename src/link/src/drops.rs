//! Messages that were dropped, by topic and cause: bounded queues lose what they must, and none in silence.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

use parking_lot::Mutex;
use ros::ring::DropCount;
use serde::{Deserialize, Serialize};

/// Why a message was dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Cause {
    /// Newest wins.
    Replaced,
    /// Deadline-aware.
    Stale,
    /// Too big to be kept, and not seen to arrive.
    CutOff,
    /// The queue before the link was full.
    Busy,
    /// The queue before a reader was full.
    Slow,
    /// More than waits for a node to connect.
    Early,
    /// More than is kept of what counts one by one.
    Full,
    /// The publisher has left meanwhile.
    Gone,
    /// A codec's frame that refers to one that did not come.
    Undecodable,
    /// What a later version tells.
    #[serde(other)]
    Other,
}

impl Cause {
    /// Dropping is what was asked for: newest wins, none older than T_max.
    pub fn is_meant(self) -> bool {
        matches!(self, Self::Replaced | Self::Stale)
    }

    fn words(self) -> &'static str {
        match self {
            Self::Replaced => "newer ones took their place before the link could carry them",
            Self::Stale => "they were older than T_max and a newer one waited",
            Self::CutOff => "they were on their way when a connection was lost",
            Self::Busy => "they came faster than this end of the link takes them",
            Self::Slow => "whoever listens takes them too slowly",
            Self::Early => "the node had not connected to the topic yet",
            Self::Full => {
                "more latched messages and goals waited for the link than are kept (64 MB)"
            }
            Self::Gone => "their publisher was gone before they could be sent",
            Self::Undecodable => "they were encoded upon one that did not come",
            Self::Other => "for a reason that this version does not know",
        }
    }
}

/// Messages that were not sent, as was meant.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Dropped {
    /// Messages that a newer one replaced.
    pub replaced: u64,
    /// Messages that had become too old.
    pub stale: u64,
}

/// Messages of a topic that were dropped for one cause.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Drop {
    /// The topic.
    pub topic: String,
    /// The cause.
    pub cause: Cause,
    /// How many so far.
    pub count: u64,
}

impl fmt::Display for Drop {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (topic, words) = (&self.topic, self.cause.words());
        match self.count {
            1 => write!(formatter, "1 message of {topic} was dropped: {words}"),
            count => write!(
                formatter,
                "{count} messages of {topic} were dropped: {words}"
            ),
        }
    }
}

/// A counter of someone else's: how much it stands at, and whether that was the last of it.
type Counter = Box<dyn Fn() -> (u64, bool) + Send + Sync>;

struct Watched {
    topic: String,
    cause: Cause,
    seen: u64,
    counter: Counter,
}

/// How many messages were dropped, by what `K` names (a topic, a channel) and by cause.
#[derive(Debug, Clone)]
pub(crate) struct Tally<K>(BTreeMap<(K, Cause), u64>);

impl<K> Default for Tally<K> {
    fn default() -> Self {
        Self(BTreeMap::new())
    }
}

impl<K: Ord> Tally<K> {
    pub(crate) fn add(&mut self, of: K, cause: Cause, count: u64) {
        if count > 0 {
            *self.0.entry((of, cause)).or_default() += count;
        }
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = (&K, Cause, u64)> {
        let all = self.0.iter();
        all.map(|((of, cause), count)| (of, *cause, *count))
    }

    /// All that were dropped for this cause.
    pub(crate) fn because_of(&self, cause: Cause) -> u64 {
        let all = self.iter().filter(|(_, why, _)| *why == cause);
        all.map(|(_, _, count)| count).sum()
    }

    /// Forgets what counts for `of`; gives that.
    pub(crate) fn take(&mut self, of: &K) -> Vec<(Cause, u64)> {
        let mut taken = Vec::new();
        self.0.retain(|(known, cause), count| {
            if known == of {
                taken.push((*cause, *count));
            }
            known != of
        });
        taken
    }
}

impl Tally<String> {
    /// By topic.
    pub(crate) fn drops(&self) -> Vec<Drop> {
        let all = self.iter().map(|(topic, cause, count)| Drop {
            topic: topic.clone(),
            cause,
            count,
        });
        all.collect()
    }
}

/// All drops of one end of a link.
#[derive(Default)]
pub struct Drops {
    counts: Mutex<Tally<String>>,
    watched: Mutex<Vec<Watched>>,
}

impl Drops {
    /// Counts messages of a topic that were dropped.
    pub fn add(&self, topic: &str, cause: Cause, count: u64) {
        self.counts.lock().add(topic.to_owned(), cause, count);
    }

    /// Counts what this counter counts, until its owner lets go of it.
    pub fn watch(&self, topic: &str, cause: Cause, counter: Arc<DropCount>) {
        self.ask(topic, cause, move || {
            let owned = Arc::strong_count(&counter) > 1;
            (counter.get(), !owned)
        });
    }

    /// Counts what `counter` says when asked, until it says that there will be no more.
    pub fn ask(
        &self,
        topic: &str,
        cause: Cause,
        counter: impl Fn() -> (u64, bool) + Send + Sync + 'static,
    ) {
        self.watched.lock().push(Watched {
            topic: topic.to_owned(),
            cause,
            seen: 0,
            counter: Box::new(counter),
        });
    }

    /// All so far.
    pub fn all(&self) -> Vec<Drop> {
        self.watched.lock().retain_mut(|watched| {
            let (count, over) = (watched.counter)();
            self.add(
                &watched.topic,
                watched.cause,
                count.saturating_sub(watched.seen),
            );
            watched.seen = count.max(watched.seen);
            !over
        });
        self.counts.lock().drops()
    }
}

/// What of all drops is worth telling: those that are new, and those that have grown tenfold since they were told.
#[derive(Debug, Default)]
pub struct Reporter {
    told: BTreeMap<(String, Cause), u64>,
}

impl Reporter {
    /// Those to tell now.
    pub fn news(&mut self, all: &[Drop]) -> Vec<Drop> {
        let mut news = Vec::new();
        for drop in all {
            let told = self
                .told
                .entry((drop.topic.clone(), drop.cause))
                .or_default();
            if drop.count >= told.saturating_mul(10).max(1) {
                *told = drop.count;
                news.push(drop.clone());
            }
        }
        news
    }
}

#[cfg(test)]
mod tests {
    use ros::ring::Lost;

    use super::*;

    #[test]
    fn drops_are_counted_for_good_and_told_now_and_then() {
        let (drops, mut reporter) = (Drops::default(), Reporter::default());
        let counter = Arc::new(DropCount::default());
        let lost = |messages| Lost { messages, bytes: 0 };
        counter.add(lost(2));
        drops.watch("/scan", Cause::Busy, counter.clone());
        drops.add("/image", Cause::Replaced, 1);
        let told: Vec<String> = reporter
            .news(&drops.all())
            .iter()
            .map(Drop::to_string)
            .collect();
        assert_eq!(
            told,
            [
                "1 message of /image was dropped: newer ones took their place before the link could carry them",
                "2 messages of /scan were dropped: they came faster than this end of the link takes them",
            ]
        );
        drops.add("/image", Cause::Replaced, 8);
        assert!(
            reporter.news(&drops.all()).is_empty(),
            "9 are few more than 1"
        );
        counter.add(lost(23));
        drop(counter);
        drops.add("/image", Cause::Replaced, 1);
        let told: Vec<u64> = reporter
            .news(&drops.all())
            .iter()
            .map(|drop| drop.count)
            .collect();
        assert_eq!(told, [10, 25]);
        // The counter's owner is gone, its count is not.
        assert_eq!(drops.all()[1].count, 25);
        assert!(drops.watched.lock().is_empty());
    }

    #[test]
    fn causes_of_a_later_version_are_understood_as_far_as_they_can() {
        let later = r#"{"topic": "/a", "cause": "eaten", "count": 1}"#;
        let drop: Drop = serde_json::from_str(later).unwrap();
        assert_eq!(drop.cause, Cause::Other);
    }
}
