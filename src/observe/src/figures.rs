//! Figures of topics: how much is published, and how old it is when it comes.

use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use ros::bus::{Message, WireType};

use crate::follow::{Followed, Observer, Seen, follow, now};
use crate::numbered::Numbered;

/// Ages that make sense: stamps of a simulation, or of a recording, are of another time.
const AGES: std::ops::Range<i64> = -60_000_000_000..60_000_000_000;

/// Ages of a topic's messages that are kept until somebody takes the figures.
const MOST_AGES: usize = 10_000;

/// What was published on a topic in a time.
#[derive(Debug, Clone, PartialEq)]
pub struct TopicFigures {
    /// The topic.
    pub topic: String,
    /// `package/Type`.
    pub of: String,
    /// Messages.
    pub messages: u64,
    /// Bytes of them, as they are serialized.
    pub bytes: u64,
    /// From the stamp in the header to here, of the messages in the middle; none where they have no header, or one without a stamp of
    /// this time.
    pub age: Option<f64>,
}

/// Counts what flows in a servant until it is dropped.
pub struct Figures {
    counts: Arc<Counts>,
    since: Mutex<Instant>,
    _followed: Followed,
}

#[derive(Default)]
struct Counts {
    all: Mutex<Numbered<Count>>,
}

struct Count {
    topic: String,
    of: String,
    stamped: bool,
    published: bool,
    messages: u64,
    bytes: u64,
    /// Nanoseconds; of the first messages alone, where they are many.
    ages: Vec<i64>,
}

impl Figures {
    /// Of all topics that somebody publishes there.
    pub fn of(seen: Seen) -> Self {
        let counts = Arc::<Counts>::default();
        let observer = Arc::clone(&counts);
        Self {
            counts,
            since: Mutex::new(Instant::now()),
            _followed: follow(seen, observer),
        }
    }

    /// Since they were taken last, and how long that is; by name.
    pub fn take(&self) -> (Duration, Vec<TopicFigures>) {
        let since = std::mem::replace(&mut *self.since.lock(), Instant::now());
        (since.elapsed(), self.counts.take())
    }
}

impl Counts {
    fn take(&self) -> Vec<TopicFigures> {
        let mut all = self.all.lock();
        let counted = all
            .iter_mut()
            .filter(|(_, count)| count.published || count.messages > 0);
        let mut taken: Vec<TopicFigures> = counted.map(|(_, count)| count.take()).collect();
        all.retain(|_, count| count.published);
        taken.sort_by(|a, b| a.topic.cmp(&b.topic));
        taken
    }
}

impl Count {
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

impl Observer for Counts {
    fn wants(&self, _topic: &str, _named: &str) -> bool {
        true
    }

    fn begins(&self, topic: &str, of: WireType) -> Option<u32> {
        let mut all = self.all.lock();
        let known = all.find(|count| count.topic == topic && count.of == of.name);
        if let Some(number) = known {
            all.get_mut(number)?.published = true;
            return Some(number);
        }
        if all.is_full() {
            // Nobody takes them, and topics come and go.
            all.retain(|_, count| count.published);
        }
        all.add(Count {
            topic: topic.to_owned(),
            stamped: is_stamped(&of.definition),
            of: of.name,
            published: true,
            messages: 0,
            bytes: 0,
            ages: Vec::new(),
        })
    }

    fn hears(&self, topic: u32, message: Message) {
        let mut all = self.all.lock();
        let Some(count) = all.get_mut(topic) else {
            return;
        };
        count.messages += 1;
        count.bytes += message.bytes.len() as u64;
        // What was latched is as old as it is.
        if count.stamped
            && !message.latching
            && count.ages.len() < MOST_AGES
            && let Some(stamp) = header_stamp(&message.bytes)
            && let Some(age) = i64::try_from(now())
                .ok()
                .and_then(|now| now.checked_sub(stamp))
            && AGES.contains(&age)
        {
            count.ages.push(age);
        }
    }

    fn ends(&self, topic: &str) {
        let mut all = self.all.lock();
        for (_, count) in all.iter_mut().filter(|(_, count)| count.topic == topic) {
            count.published = false;
        }
    }
}

/// Of the header that a message begins with (`std_msgs/Header`: seq, stamp, frame_id), nanoseconds since 1970.
fn header_stamp(message: &[u8]) -> Option<i64> {
    let word = |at: usize| {
        let bytes = message.get(at..at + 4)?;
        bytes.try_into().ok().map(u32::from_le_bytes)
    };
    Some(i64::from(word(4)?) * 1_000_000_000 + i64::from(word(8)?))
}

/// Whether messages of this definition begin with a header.
fn is_stamped(definition: &str) -> bool {
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
    use crate::numbered::MOST;

    #[test]
    fn messages_that_begin_with_a_header_have_a_stamp() {
        assert!(is_stamped(
            "# A picture\n\nuint8 X=1\nHeader header # when\nuint32 height\n"
        ));
        assert!(is_stamped("std_msgs/Header header"));
        assert!(!is_stamped("string data\nHeader header"));
        assert!(!is_stamped(""));
        let message = [[9, 0, 0, 0], [2, 0, 0, 0], [5, 0, 0, 0]].concat();
        assert_eq!(header_stamp(&message), Some(2_000_000_005));
        assert_eq!(header_stamp(&message[..11]), None);
    }

    #[test]
    fn figures_that_nobody_takes_are_bounded() {
        let counts = Counts::default();
        let of = WireType::new("a/Stamped", "digest", "Header header");
        let topic = counts.begins("/scan", of.clone()).expect("room");
        let seconds = u32::try_from(now() / 1_000_000_000).expect("this century");
        let words = [0, seconds, 0].map(u32::to_le_bytes);
        let message = Message {
            bytes: words.concat().into(),
            wire_type: Arc::new(of.clone()),
            publisher: ros::bus::PeerId::from("/node"),
            latching: false,
        };
        let many = MOST_AGES + 10;
        (0..many).for_each(|_| counts.hears(topic, message.clone()));
        let ages = |number| counts.all.lock().get(number).map(|count| count.ages.len());
        assert_eq!(ages(topic), Some(MOST_AGES));
        // Topics that come and go, too.
        for number in 0..2 * MOST {
            let topic = format!("/topic{number}");
            assert!(counts.begins(&topic, of.clone()).is_some(), "{topic}");
            counts.ends(&topic);
        }
        let taken = counts.take();
        assert_eq!(taken.len(), 1, "{taken:?}");
        assert_eq!(taken[0].messages, many as u64);
        assert_eq!(counts.all.lock().iter_mut().count(), 1);
        // What has just ended is told once more.
        counts.hears(topic, message);
        counts.ends("/scan");
        assert_eq!((counts.take().len(), counts.take().len()), (1, 0));
    }
}
