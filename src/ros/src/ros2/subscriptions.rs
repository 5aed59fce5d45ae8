//! Topics that this node subscribes to: several local subscriptions share one set of readers.
//!
//! A subscription's quality is a wish: a publisher that offers less is heard, too. DDS knows no wishes, so there is a reader for
//! each quality that publishers offer, at most the one that is wished for. A reader of a lesser quality matches better writers,
//! too: what it brings of those is left to the reader that is theirs.
//!
//! ```text
//!   wish: reliable, transient_local
//!   writer A: reliable, transient_local ─▶ reader of that quality   ─▶┐
//!   writer B: best_effort, volatile     ─▶ best_effort and volatile ─▶┴▶ all local queues
//!   writer A                            ─▶ best_effort and volatile ─▶ nobody
//! ```

mod readers;

use std::collections::HashMap;
use std::sync::Arc;

use bytes::Bytes;
use parking_lot::Mutex;
use rtps::{Discovered, Durability, EndpointData, Guid, Sample, Sink};
use tokio::sync::{Notify, watch};
use tokio::task::AbortHandle;

use self::readers::Readers;
use super::bus::Inner;
use super::quality::{self, Quality};
use super::seen::{self, Seen};
use crate::bus::{
    BusError, Matched, Message, MessageSender, Offer, PeerId, Qos, Subscription, WireType,
    message_queue,
};

/// A message that is kept, and shorter than this, is copied out of the buffer that it came in with others.
const BIG: usize = 64 * 1024;

/// Messages that are held until it is known whose they are, and their bytes. Beyond, nobody waits for that.
const MOST_HELD: usize = 64;
const MOST_BYTES_HELD: usize = 16 << 20;

/// Which readers subscriptions share: topic, name of the type, quality.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Key {
    topic: String,
    /// `*` where it does not matter.
    type_name: String,
    wish: Quality,
}

/// Topics that are subscribed to.
pub(super) type Topics = Mutex<HashMap<Key, Arc<TopicIn>>>;

/// One topic with everyone here who wants it in one quality.
pub(super) struct TopicIn {
    key: Key,
    depth: usize,
    locals: Mutex<Locals>,
    /// What is known of each writer that was heard or found.
    sources: Mutex<HashMap<Guid, Arc<Source>>>,
    matched: watch::Sender<Matched>,
    /// Woken when there are other local subscriptions than before.
    changed: Notify,
    /// Keeps its readers.
    following: Mutex<Option<AbortHandle>>,
    discovered: watch::Receiver<Arc<Discovered>>,
    seen: watch::Receiver<Arc<Seen>>,
}

#[derive(Default)]
struct Locals {
    next: u64,
    list: Vec<Local>,
    /// The last message of each writer that is transient-local: for locals that come later.
    latched: HashMap<Guid, Message>,
    /// Messages of writers whose node is not known yet, in order: it is told in a moment, and a message says whose it is.
    held: Vec<Held>,
}

struct Held {
    writer: Guid,
    /// What was known of it then.
    source: Arc<Source>,
    quality: Quality,
    bytes: Bytes,
}

struct Local {
    id: u64,
    sender: MessageSender,
    wanted: WireType,
}

impl Local {
    fn send(&self, message: Message) {
        if self.wanted.agrees(&message.wire_type) {
            self.sender.send(message);
        }
    }
}

/// A writer of the topic.
#[derive(Debug)]
struct Source {
    peer: PeerId,
    offer: Offer,
    /// The quality of the reader that hears it.
    quality: Quality,
    /// Its type as DDS has it.
    type_name: String,
    /// Whether it is known whose it is, as far as it will be.
    named: bool,
}

impl Source {
    fn of(writer: &EndpointData, wish: Quality, seen: &Seen) -> Self {
        Self {
            peer: seen.peer(writer.guid),
            offer: Offer {
                wire_type: Arc::new(seen::wire_type(writer)),
                latching: quality::is_latching(writer),
            },
            quality: wish.at_most(&writer.qos),
            type_name: writer.type_name.clone(),
            named: seen.is_named(writer.guid),
        }
    }
}

/// Subscribes; with the topic's first local subscription of its kind the readers are made.
pub(super) fn subscribe(
    bus: &Arc<Inner>,
    name: &str,
    wanted: WireType,
    qos: Qos,
) -> Result<Subscription, BusError> {
    let key = Key {
        topic: name.to_owned(),
        type_name: wanted.name.clone(),
        wish: Quality::of(&qos),
    };
    let (sender, messages) = message_queue(qos.depth);
    let mut topics = bus.subscriptions.lock();
    let known = topics.get(&key).cloned();
    let topic = known
        .clone()
        .unwrap_or_else(|| Arc::new(TopicIn::new(bus, &key, qos.depth)));
    // Before there is a reader: nothing that it brings is to be missed.
    let id = topic.add(sender, wanted);
    if known.is_none() {
        let readers = Readers::open(bus, &topic)?;
        *topic.following.lock() = Some(bus.spawn(readers.follow()));
        topics.insert(key, Arc::clone(&topic));
    }
    drop(topics);
    Ok(Subscription {
        dropped: messages.dropped(),
        messages,
        matched: topic.matched.subscribe(),
        guard: Box::new(Guard {
            bus: Arc::clone(bus),
            topic,
            id,
        }),
    })
}

impl TopicIn {
    fn new(bus: &Inner, key: &Key, depth: usize) -> Self {
        Self {
            key: key.clone(),
            depth,
            locals: Mutex::default(),
            sources: Mutex::default(),
            matched: watch::Sender::default(),
            changed: Notify::new(),
            following: Mutex::default(),
            discovered: bus.participant.discovered(),
            seen: bus.seen.subscribe(),
        }
    }

    fn add(&self, sender: MessageSender, wanted: WireType) -> u64 {
        let mut locals = self.locals.lock();
        locals.next += 1;
        let id = locals.next;
        let local = Local { id, sender, wanted };
        for message in locals.latched.values() {
            local.send(message.clone());
        }
        locals.list.push(local);
        self.changed.notify_one();
        id
    }

    /// What somebody here wants; whether that is what a publisher of this type sends.
    fn wanted(&self, theirs: &WireType) -> Result<(), WireType> {
        let locals = self.locals.lock();
        let mut wanted = locals.list.iter().map(|local| &local.wanted);
        let first = wanted.next();
        match first {
            Some(ours) if !ours.agrees(theirs) && !wanted.any(|ours| ours.agrees(theirs)) => {
                Err(ours.clone())
            }
            _ => Ok(()),
        }
    }

    /// The first type that somebody here names with its digest, else the first one.
    fn announced(&self) -> Option<WireType> {
        let locals = self.locals.lock();
        let mut wanted = locals.list.iter().map(|local| &local.wanted);
        let first = wanted.next();
        let mut all = first.into_iter().chain(wanted);
        all.find(|it| !it.digest.is_any()).or(first).cloned()
    }

    /// What is known of a writer. One that is heard was discovered, whether or not its readers were looked at since.
    fn source(&self, writer: Guid) -> Option<Arc<Source>> {
        if let Some(known) = self.sources.lock().get(&writer) {
            return Some(Arc::clone(known));
        }
        let told = self.discovered.borrow().writers.get(&writer).cloned()?;
        let seen = Arc::clone(&self.seen.borrow());
        let source = Arc::new(Source::of(&told, self.key.wish, &seen));
        self.sources.lock().insert(writer, Arc::clone(&source));
        Some(source)
    }

    /// Takes what a reader of this quality has brought.
    fn take(&self, writer: Guid, quality: Quality, bytes: Bytes) {
        let mut locals = self.locals.lock();
        let Some(source) = self.source(writer) else {
            return;
        };
        let waits = !source.named || locals.held.iter().any(|held| held.writer == writer);
        if !waits {
            return self.deliver(&mut locals, writer, &source, (quality, bytes));
        }
        locals.held.push(Held {
            writer,
            source,
            quality,
            bytes,
        });
        let held = locals.held.iter().map(|held| held.bytes.len());
        if locals.held.len() > MOST_HELD || held.sum::<usize>() > MOST_BYTES_HELD {
            self.release(&mut locals, |_| true);
        }
    }

    /// Delivers what was held of writers that are named by now, or are gone.
    fn release_named(&self) {
        let mut locals = self.locals.lock();
        if !locals.held.is_empty() {
            self.release(&mut locals, |source| source.named);
        }
    }

    fn release(&self, locals: &mut Locals, wanted: impl Fn(&Source) -> bool) {
        for held in std::mem::take(&mut locals.held) {
            // Of one that is gone nothing more will be known.
            let now = self.source(held.writer);
            let gone = now.is_none();
            let source = now.unwrap_or(held.source);
            if gone || wanted(&source) {
                self.deliver(locals, held.writer, &source, (held.quality, held.bytes));
            } else {
                locals.held.push(Held { source, ..held });
            }
        }
    }

    fn deliver(
        &self,
        locals: &mut Locals,
        writer: Guid,
        source: &Source,
        (quality, bytes): (Quality, Bytes),
    ) {
        // Another reader is there for it.
        if source.quality != quality {
            return;
        }
        let message = Message {
            bytes,
            wire_type: Arc::clone(&source.offer.wire_type),
            publisher: source.peer.clone(),
            latching: source.offer.latching,
        };
        if message.latching && self.key.wish.durability >= Durability::TransientLocal {
            let mut kept = message.clone();
            if kept.bytes.len() < BIG {
                kept.bytes = Bytes::copy_from_slice(&kept.bytes);
            }
            locals.latched.insert(writer, kept);
        }
        if let Some((last, others)) = locals.list.split_last() {
            for local in others {
                local.send(message.clone());
            }
            last.send(message);
        }
    }

    /// Ends all local subscriptions.
    pub(super) fn end(&self) {
        if let Some(following) = self.following.lock().take() {
            following.abort();
        }
        let ended = std::mem::take(&mut *self.locals.lock());
        drop(ended);
    }
}

/// What one reader brings.
struct Ear {
    topic: Arc<TopicIn>,
    quality: Quality,
}

impl Sink for Ear {
    fn sample(&self, sample: Sample) {
        self.topic.take(sample.writer, self.quality, sample.payload);
    }
}

/// One local subscription.
struct Guard {
    bus: Arc<Inner>,
    topic: Arc<TopicIn>,
    id: u64,
}

impl Drop for Guard {
    fn drop(&mut self) {
        let mut topics = self.bus.subscriptions.lock();
        let mut locals = self.topic.locals.lock();
        locals.list.retain(|local| local.id != self.id);
        let empty = locals.list.is_empty();
        drop(locals);
        let key = &self.topic.key;
        let current = topics
            .get(key)
            .is_some_and(|it| Arc::ptr_eq(it, &self.topic));
        if empty && current {
            topics.remove(key);
        }
        drop(topics);
        match empty {
            true => self.topic.end(),
            false => self.topic.changed.notify_one(),
        }
    }
}
