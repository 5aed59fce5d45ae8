//! Topics that this node subscribes to: several local subscriptions share one set of connections.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use bytes::Bytes;
use parking_lot::Mutex;
use ros_bus::{
    BusError, MatchedPeers, PeerId, QosProfile, SerializedMessage, Subscription, TopicPeer, WireType, message_queue,
};
use tokio::sync::watch;

use super::endpoint_owner::EndpointOwner;
use super::link;
use super::registrar::Kind;
use super::state::Ros1BusState;
use super::topic_in::{LocalSubscriber, LocalSubscribers, PublisherLink, PublisherLinks, TopicIn};
use crate::tcpros;

impl LocalSubscriber {
    fn send(&self, message: SerializedMessage) {
        if self.wanted.is_compatible_with(&message.wire_type) {
            self.sender.send(message);
        }
    }
}

/// Subscribes, and registers the topic if this is its first local subscription.
pub(crate) async fn subscribe(
    bus: &Arc<Ros1BusState>,
    name: &str,
    wanted: WireType,
    qos: QosProfile,
    end: EndpointOwner,
) -> Result<Subscription, BusError> {
    let (sender, messages) = message_queue(qos.depth);
    let id = bus.next_id();
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
        topic.add(LocalSubscriber { id, end, sender, wanted });
        bus.registrar.set_wanted(Kind::Subscriber, name, Some(&topic.type_name()));
        (topic.clone(), first)
    };
    let guard = SubscriptionGuard { bus: bus.clone(), topic: topic.clone(), id };
    topic.deliver_own_latched(bus, id);
    // A new set of connections must learn the publishers, even if an earlier registration still stands.
    let answer = bus.registrar.sync(Kind::Subscriber, name, first).await?;
    if let Some(publishers) = answer {
        topic.update(bus, &publishers.to_strings());
    }
    Ok(Subscription {
        dropped: messages.drop_counter(),
        messages,
        matched: topic.matched.subscribe(),
        guard: Box::new(guard),
    })
}

/// Returns the actions of this node that listen to a topic.
pub(super) fn action_peers(bus: &Ros1BusState, name: &str) -> Vec<PeerId> {
    let topic = bus.subscriptions.lock().get(name).cloned();
    topic.map_or_else(Vec::new, |topic| topic.action_peers(&bus.node))
}

/// Delivers a message published by this node through an endpoint of owner `by` to the local subscriptions that are to
/// receive it.
pub(super) fn deliver_locally(bus: &Ros1BusState, name: &str, by: EndpointOwner, message: &SerializedMessage) {
    let topic = bus.subscriptions.lock().get(name).cloned();
    let Some(topic) = topic else { return };
    for local in &topic.locals.lock().list {
        if by == EndpointOwner::Action || local.end == EndpointOwner::Action {
            local.send(message.clone());
        }
    }
}

impl TopicIn {
    fn action_peers(&self, node: &str) -> Vec<PeerId> {
        let locals = self.locals.lock();
        let actions = locals.list.iter().filter(|local| local.end == EndpointOwner::Action);
        let ids = actions.map(|local| PeerId::new(node, local.id.unsigned_abs().into()));
        ids.collect()
    }

    /// Gives a new subscription the messages latched by this node, and informs its publishers.
    fn deliver_own_latched(&self, bus: &Ros1BusState, id: i32) {
        let published = bus.publications.lock().get(&self.name).cloned();
        let Some(published) = published else { return };
        let locals = self.locals.lock();
        let new = locals.list.iter().find(|local| local.id == id);
        let Some(new) = new else { return };
        for message in published.latched_messages(&bus.node, new.end) {
            new.send(message);
        }
        drop(locals);
        published.set_action_listeners(action_peers(bus, &self.name));
    }

    fn add(&self, local: LocalSubscriber) {
        let mut locals = self.locals.lock();
        for message in locals.latched.values() {
            local.send(message.clone());
        }
        locals.list.push(local);
    }

    /// Returns the type to request from publishers: the one all local subscriptions agree on, or any.
    pub(super) fn requested_type(&self) -> WireType {
        let locals = self.locals.lock();
        let mut types = locals.list.iter().map(|local| &local.wanted);
        match types.next() {
            Some(first) if types.all(|o| (&o.name, &o.digest) == (&first.name, &first.digest)) => first.clone(),
            _ => WireType::any(),
        }
    }

    /// Returns the type to register with the Master: the first one named by a local subscription.
    pub(super) fn type_name(&self) -> String {
        let locals = self.locals.lock();
        let mut types = locals.list.iter().map(|local| &local.wanted);
        let named = types.find(|wanted| wanted.name != "*");
        named.map_or("*", |wanted| &wanted.name).to_owned()
    }

    /// Delivers a message of the publisher at `uri`.
    pub(super) fn deliver(&self, uri: &str, message: SerializedMessage) {
        let mut locals = self.locals.lock();
        if message.latching {
            // Kept for long: it must not keep the receive buffer alive that it shares with other messages.
            let kept = if message.bytes.len() < tcpros::BIG {
                SerializedMessage { bytes: Bytes::copy_from_slice(&message.bytes), ..message.clone() }
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

    /// Connects to new publishers and releases those no longer listed.
    pub(super) fn update(self: &Arc<Self>, bus: &Arc<Ros1BusState>, publishers: &[String]) {
        let mut links = self.links.lock();
        if links.ended {
            return;
        }
        for (uri, link) in &links.by_uri {
            link.set_listed(publishers.contains(uri));
        }
        for uri in publishers {
            let known = links.by_uri.contains_key(uri);
            // Messages published by this bus are not delivered to it.
            if !known && uri != bus.registrar.slave_uri() {
                let link = link::start(bus, self, uri);
                links.by_uri.insert(uri.clone(), link);
            }
        }
    }

    /// Removes the link, unless it was listed again meanwhile; returns true if it was removed.
    pub(super) fn release(&self, link: &Arc<PublisherLink>) -> bool {
        let mut links = self.links.lock();
        if link.is_listed() {
            return false;
        }
        links.by_uri.remove(link.uri());
        self.forget(&links, link);
        true
    }

    /// The link's publisher is connected and has given its name.
    pub(super) fn on_connected(&self, link: &PublisherLink, publisher: &PeerId) {
        let links = self.links.lock();
        let before = link.publisher.lock().clone();
        if before.is_some_and(|before| before != *publisher) {
            self.forget(&links, link);
        }
        *link.publisher.lock() = Some(publisher.clone());
        link.connected.store(true, Ordering::Relaxed);
        self.publish_matched(&links);
    }

    /// The link is disconnected; returns true if it was connected.
    pub(super) fn on_disconnected(&self, link: &PublisherLink) -> bool {
        let links = self.links.lock();
        let was_connected = link.connected.swap(false, Ordering::Relaxed);
        self.publish_matched(&links);
        was_connected
    }

    /// The link's publisher can no longer be reached: its latched message is dropped.
    pub(super) fn on_publisher_gone(&self, link: &PublisherLink) {
        self.forget(&self.links.lock(), link);
    }

    fn forget(&self, links: &PublisherLinks, link: &PublisherLink) {
        self.locals.lock().latched.remove(link.uri());
        if link.publisher.lock().take().is_some() {
            self.publish_matched(links);
        }
    }

    /// Publishes the matched publishers to the subscriptions.
    fn publish_matched(&self, links: &PublisherLinks) {
        let peers = links.by_uri.values().filter_map(|link| {
            Some(TopicPeer {
                id: link.publisher.lock().clone()?,
                connected: link.connected.load(Ordering::Relaxed),
                offer: link.offer(),
            })
        });
        let now = MatchedPeers { peers: peers.collect(), refused: Vec::new() };
        self.matched.send_if_modified(|before| {
            let news = *before != now;
            if news {
                *before = now;
            }
            news
        });
    }

    /// Closes all connections and ends all local subscriptions.
    pub(super) fn close(&self) {
        let mut links = self.links.lock();
        links.ended = true;
        for link in std::mem::take(&mut links.by_uri).into_values() {
            link.abort();
        }
        *self.locals.lock() = LocalSubscribers::default();
    }

    /// Returns the connections to publishers.
    pub(super) fn links(&self) -> Vec<Arc<PublisherLink>> {
        self.links.lock().by_uri.values().cloned().collect()
    }
}

/// One local subscription.
struct SubscriptionGuard {
    bus: Arc<Ros1BusState>,
    topic: Arc<TopicIn>,
    id: i32,
}

impl Drop for SubscriptionGuard {
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
            let current = topics.get(name).is_some_and(|t| Arc::ptr_eq(t, &self.topic));
            let gone = empty && current;
            if gone {
                topics.remove(name);
                bus.registrar.set_wanted(Kind::Subscriber, name, None);
            }
            gone
        };
        let published = bus.publications.lock().get(name).cloned();
        if let Some(published) = published {
            published.set_action_listeners(action_peers(bus, name));
        }
        if !gone {
            return;
        }
        self.topic.close();
        let (bus, name) = (bus.clone(), name.clone());
        self.bus.spawn(async move {
            let _ = bus.registrar.sync(Kind::Subscriber, &name, false).await;
        });
    }
}
