//! A black box: the last seconds of what flows in a servant, in memory, to be written into a file when something has gone wrong.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use budget::Budget;
use parking_lot::Mutex;
use recording::{Summary, Writer};
use ros::bus::{Message, WireType};

use crate::follow::{Followed, Observer, Seen, follow, now};
use crate::ring::{Bounds, Kept, Ring};

/// What is kept.
#[derive(Clone)]
pub struct BoxOptions {
    /// The last seconds.
    pub span: Duration,
    /// Bytes of messages.
    pub bytes: usize,
    /// Where these bytes are counted besides.
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
    /// From the first message to the last, without those that were latched before.
    pub span: Duration,
    /// Messages so far that were larger than all that may be kept, or for which the servant had no memory left.
    pub left_out: u64,
}

struct Inner {
    options: BoxOptions,
    ring: Mutex<Ring>,
    /// By number.
    topics: Mutex<Vec<Topic>>,
}

#[derive(Clone)]
struct Topic {
    name: String,
    of: Arc<WireType>,
}

impl BlackBox {
    /// Hears what flows there.
    pub fn of(seen: Seen, options: BoxOptions) -> Self {
        let ring = Ring::new(Bounds {
            span: options.span,
            bytes: options.bytes,
        });
        let inner = Arc::new(Inner {
            options,
            ring: Mutex::new(ring),
            topics: Mutex::default(),
        });
        let observer = Arc::clone(&inner);
        Self {
            inner,
            _followed: follow(seen, observer),
        }
    }

    /// Lets go of what is too old by now, also where nothing comes any more.
    pub fn forget(&self) {
        self.inner.ring.lock().forget(now());
    }

    /// Writes what is kept into a file; blocks.
    ///
    /// # Errors
    /// The file cannot be written; it may be there in part then.
    pub fn write(&self, mut writer: Writer) -> Result<Frozen, recording::Error> {
        let (before, kept, left_out) = {
            let mut ring = self.inner.ring.lock();
            let (before, kept) = ring.all(now());
            (before, kept, ring.left_out)
        };
        let topics = self.inner.topics.lock().clone();
        let mut channels = HashMap::new();
        for message in before.iter().chain(&kept) {
            let Some(topic) = topics.get(usize::from(message.topic)) else {
                continue;
            };
            let channel = match channels.get(&message.topic) {
                Some(channel) => *channel,
                None => {
                    let definition = topic.of.definition.as_bytes();
                    let channel = writer.channel(&topic.name, &topic.of.name, definition)?;
                    channels.insert(message.topic, channel);
                    channel
                }
            };
            writer.add(channel, message.time, &message.bytes)?;
        }
        let time = |one: Option<&Kept>| one.map_or(0, |one| one.time);
        Ok(Frozen {
            summary: writer.finish()?,
            span: Duration::from_nanos(time(kept.last()) - time(kept.first())),
            left_out,
        })
    }
}

impl Observer for Inner {
    fn wants(&self, topic: &str, _named: &str) -> bool {
        (self.options.wanted)(topic)
    }

    /// The number of before, where the topic comes again.
    fn begins(&self, topic: &str, of: WireType) -> Option<u16> {
        let mut topics = self.topics.lock();
        let known = topics
            .iter()
            .position(|known| known.name == topic && *known.of == of);
        let number = u16::try_from(known.unwrap_or(topics.len())).ok()?;
        if known.is_none() {
            topics.push(Topic {
                name: topic.to_owned(),
                of: Arc::new(of),
            });
        }
        Some(number)
    }

    fn hears(&self, topic: u16, message: Message) {
        let latched_by = message.latching.then_some(message.publisher);
        let permit = self.options.budget.take(message.bytes.len());
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
        let topics = self.topics.lock();
        let mut ring = self.ring.lock();
        for (number, _) in (0..).zip(&*topics).filter(|(_, known)| known.name == topic) {
            ring.gone(number);
        }
    }
}
