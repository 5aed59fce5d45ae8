//! Topics that this node subscribes to: several local subscriptions share one set of readers.
//!
//! A subscription's QoS is a preference: a publisher that offers less is matched too. DDS has no such preferences, so
//! there is one reader for each quality that publishers offer, up to the preferred one. A reader of lower quality also
//! matches better writers: their messages are left to the reader that is meant for them.
//!
//! ```text
//!   preferred: reliable, transient_local
//!   writer A: reliable, transient_local ─▶ reader of that quality   ─▶┐
//!   writer B: best_effort, volatile     ─▶ best_effort and volatile ─▶┴▶ all local queues
//!   writer A                            ─▶ best_effort and volatile ─▶ nobody
//! ```

mod readers;

use std::sync::Arc;

use bytes::Bytes;
use parking_lot::Mutex;
use ros_bus::ring::{Ring, RingBounds};
use ros_bus::{
    BusError, MessageSender, Offer, PeerId, QosProfile, SerializedMessage, Subscription, WireType, message_queue,
};
use rtps::{DurabilityKind, EndpointData, Guid, ReceivedSample, Sink};
use tokio::sync::{Notify, watch};

use self::readers::Readers;
use super::quality::{self, Quality};
use super::seen::{self, DiscoverySnapshot};
use super::state::Ros2BusState;
use super::topic_in::{HeldMessage, KnownWriter, ReaderSetKey, TopicIn, TopicSubscriber, TopicSubscribers};

/// Size below which a message to be kept is copied out of the receive buffer that it shares with others.
const BIG: usize = 64 * 1024;

/// Bounds of the messages of one transient-local publisher that are kept for later local subscriptions.
const LATCHED: RingBounds = RingBounds { messages: 256, bytes: 1 << 20 };

/// Maximum number, and size in bytes, of messages held until their node is known. Beyond that they are delivered
/// without it.
const MOST_HELD: usize = 64;
const MOST_BYTES_HELD: usize = 16 << 20;

impl TopicSubscriber {
    fn send(&self, message: SerializedMessage) {
        if self.wanted.is_compatible_with(&message.wire_type) {
            self.sender.send(message);
        }
    }
}

impl KnownWriter {
    fn new(writer: &EndpointData, wish: Quality, seen: &DiscoverySnapshot) -> Self {
        Self {
            peer: seen.peer(writer.guid),
            offer: Offer {
                wire_type: Arc::new(seen::wire_type(writer)),
                latching: quality::is_latching(writer),
                kept: None,
            },
            quality: wish.at_most(&writer.qos),
            type_name: writer.type_name.clone(),
            named: seen.is_named(writer.guid),
        }
    }
}

/// Subscribes; the first local subscription of its kind creates the readers.
pub(super) fn subscribe(
    bus: &Arc<Ros2BusState>,
    name: &str,
    wanted: WireType,
    qos: QosProfile,
) -> Result<Subscription, BusError> {
    let key = ReaderSetKey { topic: name.to_owned(), type_name: wanted.name.clone(), wish: Quality::from_qos(&qos) };
    let (sender, messages) = message_queue(qos.depth);
    let mut topics = bus.subscriptions.lock();
    let known = topics.get(&key).cloned();
    let topic = known.clone().unwrap_or_else(|| Arc::new(TopicIn::new(bus, &key, qos.depth)));
    // Before there is a reader, so that no message is missed.
    let id = topic.add(sender, wanted);
    if known.is_none() {
        let readers = Readers::open(bus, &topic)?;
        *topic.following.lock() = Some(bus.spawn(readers.follow()));
        topics.insert(key, Arc::clone(&topic));
    }
    drop(topics);
    Ok(Subscription {
        dropped: messages.drop_counter(),
        messages,
        matched: topic.matched.subscribe(),
        guard: Box::new(ReaderGuard { bus: Arc::clone(bus), topic, id }),
    })
}

impl TopicIn {
    fn new(bus: &Ros2BusState, key: &ReaderSetKey, depth: usize) -> Self {
        Self {
            key: key.clone(),
            depth,
            locals: Mutex::default(),
            sources: Mutex::default(),
            matched: watch::Sender::default(),
            changed: Notify::new(),
            following: Mutex::default(),
            discovered: bus.participant.watch_discovered(),
            seen: bus.seen.subscribe(),
        }
    }

    fn add(&self, sender: MessageSender, wanted: WireType) -> u64 {
        let mut locals = self.locals.lock();
        locals.next += 1;
        let id = locals.next;
        let local = TopicSubscriber { id, sender, wanted };
        for messages in locals.latched.values() {
            // As many as the writer itself would give.
            let given = messages.back().map_or(1, |last| self.kept_by(&last.publisher));
            for message in messages.iter().skip(messages.len().saturating_sub(given)) {
                local.send(message.clone());
            }
        }
        locals.list.push(local);
        self.changed.notify_one();
        id
    }

    /// Returns the number of messages that a publisher keeps for late subscribers.
    fn kept_by(&self, publisher: &PeerId) -> usize {
        let matched = self.matched.borrow();
        let peer = matched.peers.iter().find(|peer| peer.id == *publisher);
        peer.and_then(|peer| peer.offer.as_ref()?.kept).unwrap_or(1).max(1)
    }

    /// Checks that a publisher of this type matches a local subscription; otherwise returns a requested type.
    fn check_wanted(&self, theirs: &WireType) -> Result<(), WireType> {
        let locals = self.locals.lock();
        let mut wanted = locals.list.iter().map(|local| &local.wanted);
        let first = wanted.next();
        match first {
            Some(ours) if !ours.is_compatible_with(theirs) && !wanted.any(|ours| ours.is_compatible_with(theirs)) => {
                Err(ours.clone())
            }
            _ => Ok(()),
        }
    }

    /// Returns the first requested type with a known digest, or else the first one.
    fn announced_type(&self) -> Option<WireType> {
        let locals = self.locals.lock();
        let mut wanted = locals.list.iter().map(|local| &local.wanted);
        let first = wanted.next();
        let mut all = first.into_iter().chain(wanted);
        all.find(|it| !it.digest.is_any()).or(first).cloned()
    }

    /// Returns the known properties of a writer. A writer that is heard was discovered, even if the readers were not
    /// updated since.
    fn source(&self, writer: Guid) -> Option<Arc<KnownWriter>> {
        if let Some(known) = self.sources.lock().get(&writer) {
            return Some(Arc::clone(known));
        }
        let told = self.discovered.borrow().writers.get(&writer).cloned()?;
        let seen = Arc::clone(&self.seen.borrow());
        let source = Arc::new(KnownWriter::new(&told, self.key.wish, &seen));
        self.sources.lock().insert(writer, Arc::clone(&source));
        Some(source)
    }

    /// Receives a message from the reader of this quality.
    fn receive(&self, writer: Guid, quality: Quality, bytes: Bytes) {
        let mut locals = self.locals.lock();
        let Some(source) = self.source(writer) else {
            return;
        };
        let waits = !source.named || locals.held.iter().any(|held| held.writer == writer);
        if !waits {
            return self.deliver(&mut locals, writer, &source, (quality, bytes));
        }
        locals.held.push(HeldMessage { writer, source, quality, bytes });
        let held = locals.held.iter().map(|held| held.bytes.len());
        if locals.held.len() > MOST_HELD || held.sum::<usize>() > MOST_BYTES_HELD {
            self.release(&mut locals, |_| true);
        }
    }

    /// Delivers the held messages of writers that are known by now, or gone.
    fn release_named(&self) {
        let mut locals = self.locals.lock();
        if !locals.held.is_empty() {
            self.release(&mut locals, |source| source.named);
        }
    }

    fn release(&self, locals: &mut TopicSubscribers, wanted: impl Fn(&KnownWriter) -> bool) {
        for held in std::mem::take(&mut locals.held) {
            // Nothing more will become known of a writer that is gone.
            let now = self.source(held.writer);
            let gone = now.is_none();
            let source = now.unwrap_or(held.source);
            if gone || wanted(&source) {
                self.deliver(locals, held.writer, &source, (held.quality, held.bytes));
            } else {
                locals.held.push(HeldMessage { source, ..held });
            }
        }
    }

    fn deliver(
        &self,
        locals: &mut TopicSubscribers,
        writer: Guid,
        source: &KnownWriter,
        (quality, bytes): (Quality, Bytes),
    ) {
        // Another reader is meant for this writer.
        if source.quality != quality {
            return;
        }
        let message = SerializedMessage {
            bytes,
            wire_type: Arc::clone(&source.offer.wire_type),
            publisher: source.peer.clone(),
            latching: source.offer.latching,
        };
        if message.latching && self.key.wish.durability >= DurabilityKind::TransientLocal {
            let mut kept = message.clone();
            if kept.bytes.len() < BIG {
                kept.bytes = Bytes::copy_from_slice(&kept.bytes);
            }
            let messages = locals.latched.entry(writer).or_insert_with(|| Ring::new(LATCHED));
            // The oldest are displaced.
            let _ = messages.push(kept);
        }
        if let Some((last, others)) = locals.list.split_last() {
            for local in others {
                local.send(message.clone());
            }
            last.send(message);
        }
    }

    /// Ends all local subscriptions.
    pub(super) fn close(&self) {
        if let Some(following) = self.following.lock().take() {
            following.abort();
        }
        let ended = std::mem::take(&mut *self.locals.lock());
        drop(ended);
    }
}

/// Receives the messages of one reader.
struct ReaderSink {
    topic: Arc<TopicIn>,
    quality: Quality,
}

impl Sink for ReaderSink {
    fn on_sample(&self, sample: ReceivedSample) {
        self.topic.receive(sample.writer, self.quality, sample.payload);
    }
}

/// One local subscription.
struct ReaderGuard {
    bus: Arc<Ros2BusState>,
    topic: Arc<TopicIn>,
    id: u64,
}

impl Drop for ReaderGuard {
    fn drop(&mut self) {
        let mut topics = self.bus.subscriptions.lock();
        let mut locals = self.topic.locals.lock();
        locals.list.retain(|local| local.id != self.id);
        let empty = locals.list.is_empty();
        drop(locals);
        let key = &self.topic.key;
        let current = topics.get(key).is_some_and(|it| Arc::ptr_eq(it, &self.topic));
        if empty && current {
            topics.remove(key);
        }
        drop(topics);
        if empty { self.topic.close() } else { self.topic.changed.notify_one() }
    }
}
