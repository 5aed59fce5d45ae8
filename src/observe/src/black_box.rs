//! Black box: keeps the last seconds of a servant's messages in memory, to be written to a file when something goes
//! wrong.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Duration;

use budget::{Budget, Permit};
use parking_lot::Mutex;
use recording::{RecordingFormat, RecordingWriter, Summary};
use ros::bus::{RosVersion, SerializedMessage, WireType};

use crate::follow::{ObservedServant, Observer, ObserverTask, now, spawn_observer};
use crate::id_map::IdMap;
use crate::ring::{MESSAGE_OVERHEAD, RetentionBounds, Ring, StoredMessage};

/// Settings of a black box.
#[derive(Clone)]
pub struct BlackBoxSettings {
    /// Age up to which messages are kept.
    pub span: Duration,
    /// Memory limit in bytes, including the overhead per message.
    pub bytes: usize,
    /// Budget that message bytes and type definitions are charged to as well.
    pub budget: Budget,
    /// Predicate that selects the topics to record.
    pub wanted: Arc<dyn Fn(&str) -> bool + Send + Sync>,
}

/// Records a servant's messages until dropped.
pub struct BlackBox {
    inner: Arc<BlackBoxRecorder>,
    _followed: ObserverTask,
}

/// Summary of a black-box file.
#[derive(Debug)]
pub struct BlackBoxDump {
    /// The MCAP file's own summary.
    pub summary: Summary,
    /// Topics that have messages in the file, sorted by name.
    pub topics: Vec<String>,
    /// Time from the first message to the last, not counting earlier latched messages.
    pub span: Duration,
    /// Number of messages dropped so far because they exceeded the memory limit or the servant's budget.
    pub left_out: u64,
}

struct BlackBoxRecorder {
    format: RecordingFormat,
    options: BlackBoxSettings,
    /// Lock order: this lock is taken before the ring's.
    topics: Mutex<IdMap<RecordedTopic>>,
    ring: Mutex<Ring>,
}

struct RecordedTopic {
    name: String,
    of: Arc<WireType>,
    /// Set once nobody publishes the topic; the entry stays while the ring still holds messages of it.
    ended: bool,
    /// Budget permit for the topic's type definition.
    _counted: Permit,
}

impl BlackBox {
    /// Starts recording the servant's topics.
    pub fn start(seen: ObservedServant, options: BlackBoxSettings) -> Self {
        let ring = Ring::new(RetentionBounds { span: options.span, bytes: options.bytes });
        let inner = Arc::new(BlackBoxRecorder {
            format: match seen.bus.version() {
                RosVersion::One => RecordingFormat::Ros1,
                RosVersion::Two => RecordingFormat::Ros2,
            },
            options,
            topics: Mutex::default(),
            ring: Mutex::new(ring),
        });
        let observer = Arc::clone(&inner);
        Self { inner, _followed: spawn_observer(seen, observer) }
    }

    /// Returns the format in which this box's messages are written.
    pub fn format(&self) -> RecordingFormat {
        self.inner.format
    }

    /// Drops messages that have expired, even when no new ones arrive.
    pub fn evict(&self) {
        self.inner.ring.lock().evict(now());
        self.inner.forget_ended_topics(&mut self.inner.topics.lock());
    }

    /// Writes the buffered messages to a file of this box's [`format`](Self::format). Blocks.
    ///
    /// # Errors
    /// Fails if the file cannot be written; a partial file may remain.
    pub fn write(&self, mut writer: RecordingWriter) -> Result<BlackBoxDump, recording::Error> {
        let (topics, before, kept, left_out) = {
            let mut topics = self.inner.topics.lock();
            let mut ring = self.inner.ring.lock();
            let (before, kept) = ring.snapshot(now());
            let topics = topics.iter_mut().map(|(number, topic)| (number, (topic.name.clone(), Arc::clone(&topic.of))));
            let topics: HashMap<u32, _> = topics.collect();
            (topics, before, kept, ring.left_out)
        };
        let mut channels = HashMap::new();
        let mut names = BTreeSet::new();
        for message in before.iter().chain(&kept) {
            let Some((name, of)) = topics.get(&message.topic) else {
                continue;
            };
            let channel = match channels.get(&message.topic) {
                Some(channel) => *channel,
                None => {
                    let definition = of.definition.as_bytes();
                    let channel = writer.add_channel(name, &of.name, definition)?;
                    names.insert(name.clone());
                    channels.insert(message.topic, channel);
                    channel
                }
            };
            writer.add_message(channel, message.time, &message.bytes)?;
        }
        let time = |one: Option<&StoredMessage>| one.map_or(0, |one| one.time);
        Ok(BlackBoxDump {
            summary: writer.finish()?,
            topics: names.into_iter().collect(),
            span: Duration::from_nanos(time(kept.last()) - time(kept.first())),
            left_out,
        })
    }
}

impl BlackBoxRecorder {
    /// Removes topics that have ended and have no messages left in the ring.
    fn forget_ended_topics(&self, topics: &mut IdMap<RecordedTopic>) {
        let ring = self.ring.lock();
        topics.retain(|number, topic| !topic.ended || ring.has_topic(number));
    }
}

impl Observer for BlackBoxRecorder {
    fn wants_topic(&self, topic: &str, _named: &str) -> bool {
        (self.options.wanted)(topic)
    }

    /// Reuses the previous number if the topic reappears.
    fn on_topic_started(&self, topic: &str, of: WireType) -> Option<u32> {
        let mut topics = self.topics.lock();
        let known = topics.find(|known| known.name == topic && *known.of == of);
        if let Some(number) = known {
            topics.get_mut(number)?.ended = false;
            return Some(number);
        }
        if topics.is_full() {
            self.forget_ended_topics(&mut topics);
        }
        let size = of.definition.len() + of.name.len() + topic.len() + MESSAGE_OVERHEAD;
        let counted = self.options.budget.take(size).ok()?;
        topics.add(RecordedTopic { name: topic.to_owned(), of: Arc::new(of), ended: false, _counted: counted })
    }

    fn on_message(&self, topic: u32, message: SerializedMessage) {
        let latched_by = message.latching.then_some(message.publisher);
        let permit = self.options.budget.take(message.bytes.len() + MESSAGE_OVERHEAD);
        let mut ring = self.ring.lock();
        let Ok(permit) = permit else {
            ring.left_out += 1;
            return;
        };
        let kept = StoredMessage { topic, time: now(), bytes: permit.wrap_bytes(message.bytes) };
        ring.push(kept, latched_by);
    }

    /// Drops the topic's latched messages: they no longer describe anybody's state.
    fn on_topic_ended(&self, topic: &str) {
        let mut topics = self.topics.lock();
        let mut ring = self.ring.lock();
        for (number, known) in topics.iter_mut().filter(|(_, known)| known.name == topic) {
            known.ended = true;
            ring.forget_latched(number);
        }
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use ros::bus::PeerId;

    use super::*;
    use crate::id_map::MAX_VALUES;

    fn inner(budget: &Budget) -> BlackBoxRecorder {
        let bounds = RetentionBounds { span: Duration::from_secs(3600), bytes: 1 << 20 };
        BlackBoxRecorder {
            format: RecordingFormat::Ros1,
            options: BlackBoxSettings {
                span: bounds.span,
                bytes: bounds.bytes,
                budget: budget.clone(),
                wanted: Arc::new(|_| true),
            },
            topics: Mutex::default(),
            ring: Mutex::new(Ring::new(bounds)),
        }
    }

    fn message(of: &WireType) -> SerializedMessage {
        SerializedMessage {
            bytes: Bytes::new(),
            wire_type: Arc::new(of.clone()),
            publisher: PeerId::from("/node"),
            latching: false,
        }
    }

    #[test]
    fn definitions_and_empty_messages_count_as_the_servants() {
        let budget = Budget::new("servant", 100_000);
        let inner = inner(&budget);
        let of = WireType::new("a/Type", "digest", "#".repeat(50_000));
        let topic = inner.on_topic_started("/one", of.clone()).expect("room");
        assert!(budget.used_bytes() > 50_000, "{budget:?}");
        assert_eq!(inner.on_topic_started("/two", of.clone()), None, "too much");
        let before = budget.used_bytes();
        (0..10).for_each(|_| inner.on_message(topic, message(&of)));
        assert_eq!(budget.used_bytes() - before, 10 * MESSAGE_OVERHEAD);
    }

    #[test]
    fn topics_that_have_ended_are_forgotten_with_what_is_kept_of_them() {
        let budget = Budget::without_limit();
        let inner = inner(&budget);
        let of = WireType::new("a/Type", "digest", "string data");
        let kept = inner.on_topic_started("/kept", of.clone()).expect("room");
        inner.on_message(kept, message(&of));
        inner.on_topic_ended("/kept");
        for number in 0..3 * MAX_VALUES {
            let topic = format!("/topic{number}");
            assert!(inner.on_topic_started(&topic, of.clone()).is_some(), "{topic}");
            inner.on_topic_ended(&topic);
        }
        let mut topics = inner.topics.lock();
        inner.forget_ended_topics(&mut topics);
        assert_eq!(topics.iter_mut().count(), 1);
        drop(topics);
        assert_eq!(inner.on_topic_started("/kept", of), Some(kept), "as before");
        // The number of simultaneous topics is bounded.
        for number in 0..MAX_VALUES {
            let _ = inner.on_topic_started(&format!("/at/once{number}"), WireType::new("a/B", "", ""));
        }
        assert_eq!(inner.on_topic_started("/more", WireType::new("a/B", "", "")), None);
    }
}
