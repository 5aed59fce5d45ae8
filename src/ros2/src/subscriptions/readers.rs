//! The readers of one subscribed topic, and the writers they match.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::future::pending;
use std::sync::Arc;

use bytes::Bytes;
use futures_util::future::select_all;
use ros_bus::{BusError, IncompatiblePeer, MatchedPeers, Offer, PeerId, TopicPeer};
use rtps::{EndpointData, EndpointMatches, EndpointQos, Guid, TopicDescription};
use tokio::sync::watch;

use super::ReaderSink;
use crate::ends::ReaderEnd;
use crate::quality::{self, Quality};
use crate::seen::{self, DiscoverySnapshot};
use crate::state::Ros2BusState;
use crate::topic_in::{KnownWriter, TopicIn};
use crate::{names, show, type_hash};

/// Maximum number of types of one topic that a subscription to any type receives.
const MAX_TYPES: usize = 8;

/// The readers of one topic.
pub(super) struct Readers {
    bus: Arc<Ros2BusState>,
    topic: Arc<TopicIn>,
    /// Name in DDS.
    name: String,
    /// Type name in DDS; `None` for any type.
    type_name: Option<String>,
    /// Readers by type and quality.
    open: BTreeMap<(String, Quality), OpenReader>,
    /// Writers in order of appearance.
    order: Vec<Guid>,
    /// Incompatible peers that were logged.
    told: HashMap<PeerId, String>,
}

struct OpenReader {
    _reader: ReaderEnd,
    qos: EndpointQos,
    ends: watch::Receiver<Arc<EndpointMatches>>,
}

impl Readers {
    pub(super) fn open(bus: &Arc<Ros2BusState>, topic: &Arc<TopicIn>) -> Result<Self, BusError> {
        let type_name = match topic.key.type_name.as_str() {
            "*" => None,
            name => Some(names::message_type(name)?),
        };
        let mut readers = Self {
            bus: Arc::clone(bus),
            topic: Arc::clone(topic),
            name: names::topic_name(&topic.key.topic),
            type_name,
            open: BTreeMap::new(),
            order: Vec::new(),
            told: HashMap::new(),
        };
        let seen = Arc::clone(&bus.seen.borrow());
        readers.update(&seen);
        Ok(readers)
    }

    /// Runs forever.
    pub(super) async fn follow(mut self) {
        let topic = Arc::clone(&self.topic);
        let mut seen = self.bus.seen.subscribe();
        loop {
            let now = Arc::clone(&seen.borrow_and_update());
            self.update(&now);
            tokio::select! {
                changed = seen.changed() => if changed.is_err() { return },
                () = self.ends_changed() => {}
                () = topic.changed.notified() => {}
            }
        }
    }

    async fn ends_changed(&mut self) {
        let changes = self.open.values_mut().map(|open| Box::pin(open.ends.changed()));
        let changes: Vec<_> = changes.collect();
        if changes.is_empty() || select_all(changes).await.0.is_err() {
            pending::<()>().await;
        }
    }

    /// Adapts the readers to the existing writers, and publishes the matched peers.
    fn update(&mut self, seen: &DiscoverySnapshot) {
        let sources = self.sources(seen);
        let mut needed: BTreeMap<(String, Quality), Bytes> = BTreeMap::new();
        let announced = self.topic.announced_type();
        let announced = announced.map(|of| type_hash::user_data(&of.digest));
        for writer in seen.writers(&self.name) {
            if let Some(source) = sources.get(&writer.guid) {
                let key = (source.type_name.clone(), source.quality);
                let ours = announced.clone().filter(|_| self.type_name.is_some());
                needed.entry(key).or_insert_with(|| ours.unwrap_or_else(|| writer.user_data.clone()));
            }
        }
        // While there is no writer, a reader of the preferred quality shows that somebody listens. A writer that offers
        // less would be reported as incompatible because of such a reader, and nodes log a warning about that.
        if let (Some(type_name), true) = (&self.type_name, needed.is_empty()) {
            let key = (type_name.clone(), self.topic.key.wish);
            needed.insert(key, announced.unwrap_or_default());
        }
        *self.topic.sources.lock() = sources.clone();
        self.topic.release_named();
        self.open.retain(|key, _| needed.contains_key(key));
        for (key, user_data) in needed {
            if !self.open.contains_key(&key) {
                let open = self.open_one(&key, user_data);
                self.open.insert(key, open);
            }
        }
        let discovered = Arc::clone(&self.topic.discovered.borrow());
        let mut locals = self.topic.locals.lock();
        // A publisher's last message is dropped together with the publisher.
        locals.latched.retain(|writer, _| discovered.writers.contains_key(writer));
        drop(locals);
        let now = self.matched_peers(seen, &sources);
        show::log_incompatible(&mut self.told, &self.topic.key.topic, &now);
        show::publish_matched(&self.topic.matched, now);
    }

    /// Returns the writers of the requested types.
    fn sources(&self, seen: &DiscoverySnapshot) -> HashMap<Guid, Arc<KnownWriter>> {
        let known = self.topic.sources.lock().clone();
        let mut types = BTreeSet::new();
        let mut sources = HashMap::new();
        for writer in seen.writers(&self.name) {
            let wanted = match &self.type_name {
                Some(type_name) => *type_name == writer.type_name,
                None => {
                    types.contains(&writer.type_name)
                        || types.len() < MAX_TYPES && types.insert(writer.type_name.clone())
                }
            };
            if !wanted {
                continue;
            }
            let before = known.get(&writer.guid);
            let node = seen.node(writer.guid);
            let same =
                |before: &&Arc<KnownWriter>| before.peer.node() == &*node && before.named == seen.is_named(writer.guid);
            let source = match before.filter(same) {
                Some(before) => Arc::clone(before),
                None => Arc::new(KnownWriter::new(writer, self.topic.key.wish, seen)),
            };
            sources.insert(writer.guid, source);
        }
        sources
    }

    fn open_one(&self, (type_name, quality): &(String, Quality), user_data: Bytes) -> OpenReader {
        let topic = TopicDescription { name: self.name.clone(), type_name: type_name.clone(), user_data };
        let qos = quality::reader_qos(*quality, self.topic.depth);
        let ear = ReaderSink { topic: Arc::clone(&self.topic), quality: *quality };
        let reader = ReaderEnd::open(&self.bus, &topic, qos, Arc::new(ear));
        OpenReader { ends: reader.ends(), qos, _reader: reader }
    }

    /// Returns the current matched peers.
    fn matched_peers(&mut self, seen: &DiscoverySnapshot, sources: &HashMap<Guid, Arc<KnownWriter>>) -> MatchedPeers {
        let ends = self.open.iter_mut().map(|(key, open)| {
            let ends = Arc::clone(&open.ends.borrow_and_update());
            (key, (open.qos, ends))
        });
        let ends: BTreeMap<_, _> = ends.collect();
        self.order.retain(|writer| sources.contains_key(writer));
        let mut now = MatchedPeers::default();
        let named = |writer: &&Arc<EndpointData>| seen.is_named(writer.guid);
        for writer in seen.writers(&self.name).iter().filter(named) {
            if !sources.contains_key(&writer.guid) {
                let theirs = seen::wire_type(writer);
                if self.type_name.is_some() {
                    let ours = self.topic.check_wanted(&theirs).err().or_else(|| self.topic.announced_type());
                    let why = ours.map(|ours| show::type_mismatch_text(&theirs, &ours));
                    now.refused.push(IncompatiblePeer { peer: seen.peer(writer.guid), why: why.unwrap_or_default() });
                }
            } else if !self.order.contains(&writer.guid) {
                self.order.push(writer.guid);
            }
        }
        for writer in &self.order {
            let Some(source) = sources.get(writer) else {
                continue;
            };
            let key = (source.type_name.clone(), source.quality);
            let Some((qos, ends)) = ends.get(&key) else {
                continue;
            };
            let peer = source.peer.clone();
            if let Err(ours) = self.topic.check_wanted(&source.offer.wire_type) {
                let why = show::type_mismatch_text(&source.offer.wire_type, &ours);
                now.refused.push(IncompatiblePeer { peer, why });
            } else if ends.matched.iter().any(|it| it.guid == *writer) {
                now.peers.push(TopicPeer {
                    id: peer,
                    connected: ends.confirmed.contains(writer),
                    offer: Some(Offer { kept: ends.kept_samples(*writer), ..source.offer.clone() }),
                });
            } else if let Some((it, why)) = ends.refused.iter().find(|(it, _)| it.guid == *writer) {
                let why = quality::mismatch_text(why, &it.qos, qos);
                now.refused.push(IncompatiblePeer { peer, why });
            }
        }
        now
    }
}
