//! Topic statistics: how much is published, and how old messages are on arrival.

use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use ros::bus::{SerializedMessage, WireType};

use crate::follow::{ObservedServant, Observer, ObserverTask, now, spawn_observer};
use crate::id_map::IdMap;

/// Plausible message ages in nanoseconds; stamps of a simulation or a recording lie outside.
const AGES: std::ops::Range<i64> = -60_000_000_000..60_000_000_000;

/// Limit on the ages kept for a topic until the statistics are taken.
const MOST_AGES: usize = 10_000;

/// Statistics of one topic over a period.
#[derive(Debug, Clone, PartialEq)]
pub struct TopicFigures {
    /// Name of the topic.
    pub topic: String,
    /// Message type, `package/Type`.
    pub of: String,
    /// Number of messages.
    pub messages: u64,
    /// Size of the messages in bytes, serialized.
    pub bytes: u64,
    /// Median age on arrival in seconds, by the stamp in the header; `None` if the messages have no header or no
    /// plausible stamp.
    pub age: Option<f64>,
}

/// Counts a servant's messages until dropped.
pub struct Figures {
    counts: Arc<TopicCounters>,
    since: Mutex<Instant>,
    _followed: ObserverTask,
}

#[derive(Default)]
struct TopicCounters {
    all: Mutex<IdMap<TopicCounter>>,
}

struct TopicCounter {
    topic: String,
    of: String,
    stamped: bool,
    published: bool,
    messages: u64,
    bytes: u64,
    /// Ages in nanoseconds; of the first messages only, if there are many.
    ages: Vec<i64>,
}

impl Figures {
    /// Starts counting the messages of all published topics.
    pub fn start(seen: ObservedServant) -> Self {
        let counts = Arc::<TopicCounters>::default();
        let observer = Arc::clone(&counts);
        Self { counts, since: Mutex::new(Instant::now()), _followed: spawn_observer(seen, observer) }
    }

    /// Returns the statistics since they were last taken, sorted by topic, and the length of that period.
    pub fn take(&self) -> (Duration, Vec<TopicFigures>) {
        let since = std::mem::replace(&mut *self.since.lock(), Instant::now());
        (since.elapsed(), self.counts.take())
    }
}

impl TopicCounters {
    fn take(&self) -> Vec<TopicFigures> {
        let mut all = self.all.lock();
        let counted = all.iter_mut().filter(|(_, count)| count.published || count.messages > 0);
        let mut taken: Vec<TopicFigures> = counted.map(|(_, count)| count.take()).collect();
        all.retain(|_, count| count.published);
        taken.sort_by(|a, b| a.topic.cmp(&b.topic));
        taken
    }
}

impl TopicCounter {
    fn take(&mut self) -> TopicFigures {
        let mut ages = std::mem::take(&mut self.ages);
        ages.sort_unstable();
        let middle = ages.get(ages.len() / 2);
        TopicFigures {
            topic: self.topic.clone(),
            of: self.of.clone(),
            messages: std::mem::take(&mut self.messages),
            bytes: std::mem::take(&mut self.bytes),
            age: middle.map(|age| *age as f64 / 1e9),
        }
    }
}

impl Observer for TopicCounters {
    fn wants_topic(&self, _topic: &str, _named: &str) -> bool {
        true
    }

    fn on_topic_started(&self, topic: &str, of: WireType) -> Option<u32> {
        let mut all = self.all.lock();
        let known = all.find(|count| count.topic == topic && count.of == of.name);
        if let Some(number) = known {
            all.get_mut(number)?.published = true;
            return Some(number);
        }
        if all.is_full() {
            // Nobody takes the statistics while topics come and go.
            all.retain(|_, count| count.published);
        }
        all.add(TopicCounter {
            topic: topic.to_owned(),
            stamped: has_header(&of.definition),
            of: of.name,
            published: true,
            messages: 0,
            bytes: 0,
            ages: Vec::new(),
        })
    }

    fn on_message(&self, topic: u32, message: SerializedMessage) {
        let mut all = self.all.lock();
        let Some(count) = all.get_mut(topic) else {
            return;
        };
        count.messages += 1;
        count.bytes += message.bytes.len() as u64;
        // A latched message is as old as it is; its age says nothing about latency.
        if count.stamped
            && !message.latching
            && count.ages.len() < MOST_AGES
            && let Some(stamp) = read_header_stamp(&message.bytes)
            && let Some(age) = i64::try_from(now()).ok().and_then(|now| now.checked_sub(stamp))
            && AGES.contains(&age)
        {
            count.ages.push(age);
        }
    }

    fn on_topic_ended(&self, topic: &str) {
        let mut all = self.all.lock();
        for (_, count) in all.iter_mut().filter(|(_, count)| count.topic == topic) {
            count.published = false;
        }
    }
}

/// Reads the stamp of a message's header (`std_msgs/Header`: seq, stamp, frame_id), in nanoseconds since 1970.
fn read_header_stamp(message: &[u8]) -> Option<i64> {
    let word = |at: usize| {
        let bytes = message.get(at..at + 4)?;
        bytes.try_into().ok().map(u32::from_le_bytes)
    };
    Some(i64::from(word(4)?) * 1_000_000_000 + i64::from(word(8)?))
}

/// Returns true if messages of this definition begin with a header.
fn has_header(definition: &str) -> bool {
    let mut lines = definition.lines().map(|line| {
        let line = line.split('#').next().unwrap_or_default();
        line.trim()
    });
    let first = lines.find(|line| !line.is_empty() && !line.contains('='));
    let mut words = first.unwrap_or_default().split_whitespace();
    matches!(words.next(), Some("Header" | "std_msgs/Header"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::id_map::MAX_VALUES;

    #[test]
    fn messages_that_begin_with_a_header_have_a_stamp() {
        assert!(has_header("# A picture\n\nuint8 X=1\nHeader header # when\nuint32 height\n"));
        assert!(has_header("std_msgs/Header header"));
        assert!(!has_header("string data\nHeader header"));
        assert!(!has_header(""));
        let message = [[9, 0, 0, 0], [2, 0, 0, 0], [5, 0, 0, 0]].concat();
        assert_eq!(read_header_stamp(&message), Some(2_000_000_005));
        assert_eq!(read_header_stamp(&message[..11]), None);
    }

    #[test]
    fn figures_that_nobody_takes_are_bounded() {
        let counts = TopicCounters::default();
        let of = WireType::new("a/Stamped", "digest", "Header header");
        let topic = counts.on_topic_started("/scan", of.clone()).expect("room");
        let seconds = u32::try_from(now() / 1_000_000_000).expect("this century");
        let words = [0, seconds, 0].map(u32::to_le_bytes);
        let message = SerializedMessage {
            bytes: words.concat().into(),
            wire_type: Arc::new(of.clone()),
            publisher: ros::bus::PeerId::from("/node"),
            latching: false,
        };
        let many = MOST_AGES + 10;
        (0..many).for_each(|_| counts.on_message(topic, message.clone()));
        let ages = |number| counts.all.lock().get(number).map(|count| count.ages.len());
        assert_eq!(ages(topic), Some(MOST_AGES));
        // Topics that come and go are bounded, too.
        for number in 0..2 * MAX_VALUES {
            let topic = format!("/topic{number}");
            assert!(counts.on_topic_started(&topic, of.clone()).is_some(), "{topic}");
            counts.on_topic_ended(&topic);
        }
        let taken = counts.take();
        assert_eq!(taken.len(), 1, "{taken:?}");
        assert_eq!(taken[0].messages, many as u64);
        assert_eq!(counts.all.lock().iter_mut().count(), 1);
        // A topic that has just ended is reported once more.
        counts.on_message(topic, message);
        counts.on_topic_ended("/scan");
        assert_eq!((counts.take().len(), counts.take().len()), (1, 0));
    }
}
