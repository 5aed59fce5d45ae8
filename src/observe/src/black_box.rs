//! A black box: the last seconds of what flows in a servant, in memory, to be written into a file when something has gone wrong.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Duration;

use budget::{Budget, Permit};
use parking_lot::Mutex;
use recording::{Format, Summary, Writer};
use ros::bus::{Message, RosVersion, WireType};

use crate::follow::{Followed, Observer, Seen, follow, now};
use crate::numbered::Numbered;
use crate::ring::{Bounds, EACH, Kept, Ring};

/// What is kept.
#[derive(Clone)]
pub struct BoxOptions {
    /// The last seconds.
    pub span: Duration,
    /// Bytes of messages, with what each takes beside its own.
    pub bytes: usize,
    /// Where these bytes are counted besides, and those of definitions.
    pub budget: Budget,
    /// Which topics are heard.
    pub wanted: Arc<dyn Fn(&str) -> bool + Send + Sync>,
}

/// Hears a servant until it is dropped.
pub struct BlackBox {
    inner: Arc<Inner>,
    _followed: Followed,
}

/// What a file holds.
#[derive(Debug)]
pub struct Frozen {
    /// The file.
    pub summary: Summary,
    /// The topics that it has messages of, by name.
    pub topics: Vec<String>,
    /// From the first message to the last, without those that were latched before.
    pub span: Duration,
    /// Messages so far that were larger than all that may be kept, or for which the servant had no memory left.
    pub left_out: u64,
}

struct Inner {
    format: Format,
    options: BoxOptions,
    /// Locked before the ring, where both are.
    topics: Mutex<Numbered<Topic>>,
    ring: Mutex<Ring>,
}

struct Topic {
    name: String,
    of: Arc<WireType>,
    /// Nobody publishes it any more: it is known for as long as something of it is kept.
    ended: bool,
    /// What its definition takes.
    _counted: Permit,
}

impl BlackBox {
    /// Hears what flows there.
    pub fn of(seen: Seen, options: BoxOptions) -> Self {
        let ring = Ring::new(Bounds {
            span: options.span,
            bytes: options.bytes,
        });
        let inner = Arc::new(Inner {
            format: match seen.bus.version() {
                RosVersion::One => Format::Ros1,
                RosVersion::Two => Format::Ros2,
            },
            options,
            topics: Mutex::default(),
            ring: Mutex::new(ring),
        });
        let observer = Arc::clone(&inner);
        Self {
            inner,
            _followed: follow(seen, observer),
        }
    }

    /// How a file of it is to be written.
    pub fn format(&self) -> Format {
        self.inner.format
    }

    /// Lets go of what is too old by now, also where nothing comes any more.
    pub fn forget(&self) {
        self.inner.ring.lock().forget(now());
        self.inner.forget_topics(&mut self.inner.topics.lock());
    }

    /// Writes what is kept into a file of this box's [`format`](Self::format); blocks.
    ///
    /// # Errors
    /// The file cannot be written; it may be there in part then.
    pub fn write(&self, mut writer: Writer) -> Result<Frozen, recording::Error> {
        let (topics, before, kept, left_out) = {
            let mut topics = self.inner.topics.lock();
            let mut ring = self.inner.ring.lock();
            let (before, kept) = ring.all(now());
            let topics = topics
                .iter_mut()
                .map(|(number, topic)| (number, (topic.name.clone(), Arc::clone(&topic.of))));
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
                    let channel = writer.channel(name, &of.name, definition)?;
                    names.insert(name.clone());
                    channels.insert(message.topic, channel);
                    channel
                }
            };
            writer.add(channel, message.time, &message.bytes)?;
        }
        let time = |one: Option<&Kept>| one.map_or(0, |one| one.time);
        Ok(Frozen {
            summary: writer.finish()?,
            topics: names.into_iter().collect(),
            span: Duration::from_nanos(time(kept.last()) - time(kept.first())),
            left_out,
        })
    }
}

impl Inner {
    /// Lets go of topics that have ended, and of which nothing is kept.
    fn forget_topics(&self, topics: &mut Numbered<Topic>) {
        let ring = self.ring.lock();
        topics.retain(|number, topic| !topic.ended || ring.has(number));
    }
}

impl Observer for Inner {
    fn wants(&self, topic: &str, _named: &str) -> bool {
        (self.options.wanted)(topic)
    }

    /// The number of before, where the topic comes again.
    fn begins(&self, topic: &str, of: WireType) -> Option<u32> {
        let mut topics = self.topics.lock();
        let known = topics.find(|known| known.name == topic && *known.of == of);
        if let Some(number) = known {
            topics.get_mut(number)?.ended = false;
            return Some(number);
        }
        if topics.is_full() {
            self.forget_topics(&mut topics);
        }
        let size = of.definition.len() + of.name.len() + topic.len() + EACH;
        let counted = self.options.budget.take(size).ok()?;
        topics.add(Topic {
            name: topic.to_owned(),
            of: Arc::new(of),
            ended: false,
            _counted: counted,
        })
    }

    fn hears(&self, topic: u32, message: Message) {
        let latched_by = message.latching.then_some(message.publisher);
        let permit = self.options.budget.take(message.bytes.len() + EACH);
        let mut ring = self.ring.lock();
        let Ok(permit) = permit else {
            ring.left_out += 1;
            return;
        };
        let kept = Kept {
            topic,
            time: now(),
            bytes: permit.around(message.bytes),
        };
        ring.push(kept, latched_by);
    }

    /// What was latched there is nobody's state any more.
    fn ends(&self, topic: &str) {
        let mut topics = self.topics.lock();
        let mut ring = self.ring.lock();
        for (number, known) in topics.iter_mut().filter(|(_, known)| known.name == topic) {
            known.ended = true;
            ring.gone(number);
        }
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use ros::bus::PeerId;

    use super::*;
    use crate::numbered::MOST;

    fn inner(budget: &Budget) -> Inner {
        let bounds = Bounds {
            span: Duration::from_secs(3600),
            bytes: 1 << 20,
        };
        Inner {
            format: Format::Ros1,
            options: BoxOptions {
                span: bounds.span,
                bytes: bounds.bytes,
                budget: budget.clone(),
                wanted: Arc::new(|_| true),
            },
            topics: Mutex::default(),
            ring: Mutex::new(Ring::new(bounds)),
        }
    }

    fn message(of: &WireType) -> Message {
        Message {
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
        let topic = inner.begins("/one", of.clone()).expect("room");
        assert!(budget.used() > 50_000, "{budget:?}");
        assert_eq!(inner.begins("/two", of.clone()), None, "too much");
        let before = budget.used();
        (0..10).for_each(|_| inner.hears(topic, message(&of)));
        assert_eq!(budget.used() - before, 10 * EACH);
    }

    #[test]
    fn topics_that_have_ended_are_forgotten_with_what_is_kept_of_them() {
        let budget = Budget::unlimited();
        let inner = inner(&budget);
        let of = WireType::new("a/Type", "digest", "string data");
        let kept = inner.begins("/kept", of.clone()).expect("room");
        inner.hears(kept, message(&of));
        inner.ends("/kept");
        for number in 0..3 * MOST {
            let topic = format!("/topic{number}");
            assert!(inner.begins(&topic, of.clone()).is_some(), "{topic}");
            inner.ends(&topic);
        }
        let mut topics = inner.topics.lock();
        inner.forget_topics(&mut topics);
        assert_eq!(topics.iter_mut().count(), 1);
        drop(topics);
        assert_eq!(inner.begins("/kept", of), Some(kept), "as before");
        // No more than that at once.
        for number in 0..MOST {
            let _ = inner.begins(&format!("/at/once{number}"), WireType::new("a/B", "", ""));
        }
        assert_eq!(inner.begins("/more", WireType::new("a/B", "", "")), None);
    }
}
