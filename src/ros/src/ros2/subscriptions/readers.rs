//! The readers of one topic that is subscribed to: which there are, and whom they hear.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::future::pending;
use std::sync::Arc;

use bytes::Bytes;
use futures_util::future::select_all;
use rtps::{EndpointData, EndpointQos, Ends, Guid, Topic};
use tokio::sync::watch;

use super::{Ear, Source, TopicIn};
use crate::bus::{BusError, Matched, Peer, PeerId, Refusal};
use crate::ros2::bus::Inner;
use crate::ros2::ends::ReaderEnd;
use crate::ros2::quality::{self, Quality};
use crate::ros2::seen::{self, Seen};
use crate::ros2::{names, show, type_hash};

/// A subscription to messages of any type hears so many types of one topic.
const MAX_TYPES: usize = 8;

/// The readers of one topic.
pub(super) struct Readers {
    bus: Arc<Inner>,
    topic: Arc<TopicIn>,
    /// As DDS has it.
    name: String,
    /// The type as DDS has it; none where all are wanted.
    type_name: Option<String>,
    /// By type and quality.
    open: BTreeMap<(String, Quality), Open>,
    /// Writers in the order in which they came.
    order: Vec<Guid>,
    /// Refusals that were logged.
    told: HashMap<PeerId, String>,
}

struct Open {
    _reader: ReaderEnd,
    qos: EndpointQos,
    ends: watch::Receiver<Arc<Ends>>,
}

impl Readers {
    pub(super) fn open(bus: &Arc<Inner>, topic: &Arc<TopicIn>) -> Result<Self, BusError> {
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
        readers.look(&seen);
        Ok(readers)
    }

    /// Follows for ever.
    pub(super) async fn follow(mut self) {
        let topic = Arc::clone(&self.topic);
        let mut seen = self.bus.seen.subscribe();
        loop {
            let now = Arc::clone(&seen.borrow_and_update());
            self.look(&now);
            tokio::select! {
                changed = seen.changed() => if changed.is_err() { return },
                () = self.ends_changed() => {}
                () = topic.changed.notified() => {}
            }
        }
    }

    async fn ends_changed(&mut self) {
        let changes = self
            .open
            .values_mut()
            .map(|open| Box::pin(open.ends.changed()));
        let changes: Vec<_> = changes.collect();
        if changes.is_empty() || select_all(changes).await.0.is_err() {
            pending::<()>().await;
        }
    }

    /// Brings the readers in line with the writers that are there, and shows those.
    fn look(&mut self, seen: &Seen) {
        let sources = self.sources(seen);
        let mut needed: BTreeMap<(String, Quality), Bytes> = BTreeMap::new();
        let announced = self.topic.announced();
        let announced = announced.map(|of| type_hash::user_data(&of.digest));
        for writer in seen.writers(&self.name) {
            if let Some(source) = sources.get(&writer.guid) {
                let key = (source.type_name.clone(), source.quality);
                let ours = announced.clone().filter(|_| self.type_name.is_some());
                needed
                    .entry(key)
                    .or_insert_with(|| ours.unwrap_or_else(|| writer.user_data.clone()));
            }
        }
        // What is wished for shows that somebody listens, until there is a writer. One that offers less would be told that it is
        // incompatible by such a reader, and nodes write a warning of that into their logs.
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
        // What a publisher has left behind goes with it.
        locals
            .latched
            .retain(|writer, _| discovered.writers.contains_key(writer));
        drop(locals);
        let now = self.matched(seen, &sources);
        show::refusals(&mut self.told, &self.topic.key.topic, &now);
        show::matched(&self.topic.matched, now);
    }

    /// The writers of types that are wanted.
    fn sources(&self, seen: &Seen) -> HashMap<Guid, Arc<Source>> {
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
            let same = |before: &&Arc<Source>| {
                before.peer.node() == &*node && before.named == seen.is_named(writer.guid)
            };
            let source = match before.filter(same) {
                Some(before) => Arc::clone(before),
                None => Arc::new(Source::of(writer, self.topic.key.wish, seen)),
            };
            sources.insert(writer.guid, source);
        }
        sources
    }

    fn open_one(&self, (type_name, quality): &(String, Quality), user_data: Bytes) -> Open {
        let topic = Topic {
            name: self.name.clone(),
            type_name: type_name.clone(),
            user_data,
        };
        let qos = quality::endpoint(*quality, self.topic.depth);
        let ear = Ear {
            topic: Arc::clone(&self.topic),
            quality: *quality,
        };
        let reader = ReaderEnd::open(&self.bus, &topic, qos, Arc::new(ear));
        Open {
            ends: reader.ends(),
            qos,
            _reader: reader,
        }
    }

    /// Who is at the other end now.
    fn matched(&mut self, seen: &Seen, sources: &HashMap<Guid, Arc<Source>>) -> Matched {
        let ends = self.open.iter_mut().map(|(key, open)| {
            let ends = Arc::clone(&open.ends.borrow_and_update());
            (key, (open.qos, ends))
        });
        let ends: BTreeMap<_, _> = ends.collect();
        self.order.retain(|writer| sources.contains_key(writer));
        let mut now = Matched::default();
        let named = |writer: &&Arc<EndpointData>| seen.is_named(writer.guid);
        for writer in seen.writers(&self.name).iter().filter(named) {
            if !sources.contains_key(&writer.guid) {
                let theirs = seen::wire_type(writer);
                if self.type_name.is_some() {
                    let ours = self
                        .topic
                        .wanted(&theirs)
                        .err()
                        .or_else(|| self.topic.announced());
                    let why = ours.map(|ours| show::other_type(&theirs, &ours));
                    now.refused.push(Refusal {
                        peer: seen.peer(writer.guid),
                        why: why.unwrap_or_default(),
                    });
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
            if let Err(ours) = self.topic.wanted(&source.offer.wire_type) {
                let why = show::other_type(&source.offer.wire_type, &ours);
                now.refused.push(Refusal { peer, why });
            } else if ends.matched.iter().any(|it| it.guid == *writer) {
                now.peers.push(Peer {
                    id: peer,
                    connected: ends.confirmed.contains(writer),
                    offer: Some(source.offer.clone()),
                });
            } else if let Some((it, why)) = ends.refused.iter().find(|(it, _)| it.guid == *writer) {
                let why = quality::refusal(why, &it.qos, qos);
                now.refused.push(Refusal { peer, why });
            }
        }
        now
    }
}
