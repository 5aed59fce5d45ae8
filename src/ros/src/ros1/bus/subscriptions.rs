//! Topics that this node subscribes to: several local subscriptions share one set of connections.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::sync::atomic::Ordering;

use bytes::Bytes;
use parking_lot::Mutex;
use tokio::sync::watch;

use super::link::{self, Link};
use super::registrar::Kind;
use super::{End, Inner};
use crate::bus::{
    BusError, Matched, Message, MessageSender, Peer, PeerId, Qos, Subscription, WireType,
    message_queue,
};
use crate::ros1::tcpros;

/// One topic with everyone here who wants it and every publisher of it.
pub(super) struct TopicIn {
    pub(super) name: String,
    locals: Mutex<Locals>,
    links: Mutex<Links>,
    /// Publishers that have not left.
    matched: watch::Sender<Matched>,
}

/// One connection per publisher, by its address.
#[derive(Default)]
struct Links {
    by_uri: BTreeMap<String, Arc<Link>>,
    ended: bool,
}

#[derive(Default)]
struct Locals {
    list: Vec<Local>,
    /// The last message of each latching publisher, by its address: for locals that come later.
    latched: HashMap<String, Message>,
}

struct Local {
    id: i32,
    end: End,
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

/// Subscribes, and registers if this is the topic's first local subscription.
pub(in crate::ros1) async fn subscribe(
    bus: &Arc<Inner>,
    name: &str,
    wanted: WireType,
    qos: Qos,
    end: End,
) -> Result<Subscription, BusError> {
    let (sender, messages) = message_queue(qos.depth);
    let id = bus.id();
    let (topic, first) = {
        let mut topics = bus.subscriptions.lock();
        let mut first = false;
        let topic = topics.entry(name.to_owned()).or_insert_with(|| {
            first = true;
            Arc::new(TopicIn {
                name: name.to_owned(),
                locals: Mutex::default(),
                links: Mutex::default(),
                matched: watch::Sender::default(),
            })
        });
        topic.add(Local {
            id,
            end,
            sender,
            wanted,
        });
        bus.registrar
            .want(Kind::Subscriber, name, Some(&topic.type_name()));
        (topic.clone(), first)
    };
    let guard = Guard {
        bus: bus.clone(),
        topic: topic.clone(),
        id,
    };
    topic.add_own(bus, id);
    // Of a new set of connections the publishers must be learnt, even if an earlier registration still stands.
    let answer = bus.registrar.sync(Kind::Subscriber, name, first).await?;
    if let Some(publishers) = answer {
        topic.update(bus, &publishers.to_strings());
    }
    Ok(Subscription {
        dropped: messages.dropped(),
        messages,
        matched: topic.matched.subscribe(),
        guard: Box::new(guard),
    })
}

/// Actions of this node that listen to a topic.
pub(super) fn actions(bus: &Inner, name: &str) -> Vec<PeerId> {
    let topic = bus.subscriptions.lock().get(name).cloned();
    topic.map_or_else(Vec::new, |topic| topic.actions(&bus.node))
}

/// Gives those here who hear it what this node itself publishes, through an end of that kind.
pub(super) fn bring_back(bus: &Inner, name: &str, by: End, message: &Message) {
    let topic = bus.subscriptions.lock().get(name).cloned();
    let Some(topic) = topic else { return };
    for local in &topic.locals.lock().list {
        if by == End::Action || local.end == End::Action {
            local.send(message.clone());
        }
    }
}

impl TopicIn {
    fn actions(&self, node: &str) -> Vec<PeerId> {
        let locals = self.locals.lock();
        let actions = locals.list.iter().filter(|local| local.end == End::Action);
        let ids = actions.map(|local| PeerId::new(node, local.id.unsigned_abs().into()));
        ids.collect()
    }

    /// Gives a new subscription what this node has latched itself, and tells its publishers.
    fn add_own(&self, bus: &Inner, id: i32) {
        let published = bus.publications.lock().get(&self.name).cloned();
        let Some(published) = published else { return };
        let locals = self.locals.lock();
        let new = locals.list.iter().find(|local| local.id == id);
        let Some(new) = new else { return };
        for message in published.latched(&bus.node, new.end) {
            new.send(message);
        }
        drop(locals);
        published.hear(actions(bus, &self.name));
    }

    fn add(&self, local: Local) {
        let mut locals = self.locals.lock();
        for message in locals.latched.values() {
            local.send(message.clone());
        }
        locals.list.push(local);
    }

    /// What publishers are asked for: the type all locals agree on, or any.
    pub(super) fn wanted(&self) -> WireType {
        let locals = self.locals.lock();
        let mut types = locals.list.iter().map(|local| &local.wanted);
        match types.next() {
            Some(first) if types.all(|o| (&o.name, &o.digest) == (&first.name, &first.digest)) => {
                first.clone()
            }
            _ => WireType::any(),
        }
    }

    /// What the Master is told: the first type that anyone here named.
    pub(super) fn type_name(&self) -> String {
        let locals = self.locals.lock();
        let mut types = locals.list.iter().map(|local| &local.wanted);
        let named = types.find(|wanted| wanted.name != "*");
        named.map_or("*", |wanted| &wanted.name).to_owned()
    }

    /// Takes a message of the publisher at `uri`.
    pub(super) fn deliver(&self, uri: &str, message: Message) {
        let mut locals = self.locals.lock();
        if message.latching {
            // Kept for long: it must not hold on to the buffer it came in with its neighbours.
            let kept = if message.bytes.len() < tcpros::BIG {
                Message {
                    bytes: Bytes::copy_from_slice(&message.bytes),
                    ..message.clone()
                }
            } else {
                message.clone()
            };
            locals.latched.insert(uri.to_owned(), kept);
        }
        if let Some((last, others)) = locals.list.split_last() {
            for local in others {
                local.send(message.clone());
            }
            last.send(message);
        }
    }

    /// Connects to publishers that are new and lets go of those no longer listed.
    pub(super) fn update(self: &Arc<Self>, bus: &Arc<Inner>, publishers: &[String]) {
        let mut links = self.links.lock();
        if links.ended {
            return;
        }
        for (uri, link) in &links.by_uri {
            link.list(publishers.contains(uri));
        }
        for uri in publishers {
            let known = links.by_uri.contains_key(uri);
            // What this bus publishes itself is not brought back to it.
            if !known && uri != bus.registrar.slave_uri() {
                let link = link::start(bus, self, uri);
                links.by_uri.insert(uri.clone(), link);
            }
        }
    }

    /// The link has ended, unless it was listed again meanwhile.
    pub(super) fn released(&self, link: &Arc<Link>) -> bool {
        let mut links = self.links.lock();
        if link.is_listed() {
            return false;
        }
        links.by_uri.remove(link.uri());
        self.forget(&links, link);
        true
    }

    /// The link's publisher is connected, and has said its name.
    pub(super) fn came(&self, link: &Link, publisher: &PeerId) {
        let links = self.links.lock();
        let before = link.publisher.lock().clone();
        if before.is_some_and(|before| before != *publisher) {
            self.forget(&links, link);
        }
        *link.publisher.lock() = Some(publisher.clone());
        link.connected.store(true, Ordering::Relaxed);
        self.show(&links);
    }

    /// The link has lost its connection; whether it had one.
    pub(super) fn lost(&self, link: &Link) -> bool {
        let links = self.links.lock();
        let was_connected = link.connected.swap(false, Ordering::Relaxed);
        self.show(&links);
        was_connected
    }

    /// The link's publisher cannot be reached any more: what it has latched is gone with it.
    pub(super) fn left(&self, link: &Link) {
        self.forget(&self.links.lock(), link);
    }

    fn forget(&self, links: &Links, link: &Link) {
        self.locals.lock().latched.remove(link.uri());
        if link.publisher.lock().take().is_some() {
            self.show(links);
        }
    }

    /// Tells the subscriptions who is there.
    fn show(&self, links: &Links) {
        let peers = links.by_uri.values().filter_map(|link| {
            Some(Peer {
                id: link.publisher.lock().clone()?,
                connected: link.connected.load(Ordering::Relaxed),
                offer: link.offer(),
            })
        });
        let now = Matched {
            peers: peers.collect(),
            refused: Vec::new(),
        };
        self.matched.send_if_modified(|before| {
            let news = *before != now;
            if news {
                *before = now;
            }
            news
        });
    }

    /// Closes all connections and ends all local subscriptions.
    pub(super) fn end(&self) {
        let mut links = self.links.lock();
        links.ended = true;
        for link in std::mem::take(&mut links.by_uri).into_values() {
            link.abort();
        }
        *self.locals.lock() = Locals::default();
    }

    /// The connections to publishers.
    pub(super) fn links(&self) -> Vec<Arc<Link>> {
        self.links.lock().by_uri.values().cloned().collect()
    }
}

/// One local subscription.
struct Guard {
    bus: Arc<Inner>,
    topic: Arc<TopicIn>,
    id: i32,
}

impl Drop for Guard {
    fn drop(&mut self) {
        let bus = &self.bus;
        let name = &self.topic.name;
        let gone = {
            let mut topics = bus.subscriptions.lock();
            let empty = {
                let mut locals = self.topic.locals.lock();
                locals.list.retain(|local| local.id != self.id);
                locals.list.is_empty()
            };
            let current = topics
                .get(name)
                .is_some_and(|t| Arc::ptr_eq(t, &self.topic));
            let gone = empty && current;
            if gone {
                topics.remove(name);
                bus.registrar.want(Kind::Subscriber, name, None);
            }
            gone
        };
        let published = bus.publications.lock().get(name).cloned();
        if let Some(published) = published {
            published.hear(actions(bus, name));
        }
        if !gone {
            return;
        }
        self.topic.end();
        let (bus, name) = (bus.clone(), name.clone());
        self.bus.spawn(async move {
            let _ = bus.registrar.sync(Kind::Subscriber, &name, false).await;
        });
    }
}
