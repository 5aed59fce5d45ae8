//! Topics that this node publishes: several local advertisements share one set of subscribers.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use ros_bus::ring::DropTally;
use ros_bus::{BusError, MatchedPeers, PeerId, Publisher, QosProfile, SerializedMessage, TopicPeer, WireType};
use tokio::sync::{mpsc, watch};

use super::endpoint_owner::EndpointOwner;
use super::registrar::Kind;
use super::state::Ros1BusState;
use super::subscriptions;
use super::topic_out::{LocalPublisher, State, Subscriber, TopicOut};
use crate::tcpros::SendQueue;

/// Advertises, and registers the topic if this is its first local publisher.
pub(crate) async fn advertise(
    bus: &Arc<Ros1BusState>,
    name: &str,
    of: WireType,
    qos: QosProfile,
    end: EndpointOwner,
) -> Result<Box<dyn Publisher>, BusError> {
    let id = bus.next_id();
    let topic = {
        let mut topics = bus.publications.lock();
        let topic = topics.entry(name.to_owned()).or_default();
        topic.add(name, id, &of, (qos, end))?;
        bus.registrar.set_wanted(Kind::Publisher, name, Some(&of.name));
        topic.clone()
    };
    bus.publishing.notify_waiters();
    let handle = PublisherHandle {
        bus: bus.clone(),
        name: name.to_owned(),
        topic,
        id,
        end,
        of: Arc::new(of),
        latching: qos.is_latching(),
    };
    handle.topic.set_action_listeners(subscriptions::action_peers(bus, name));
    bus.registrar.sync(Kind::Publisher, name, false).await?;
    Ok(Box::new(handle))
}

/// Makes this node look like a publisher of `name`, so that subscribers connect and declare the type they request.
pub(super) fn ask_subscribers(bus: &Arc<Ros1BusState>, name: &str) -> SubscriberQuery {
    let (sender, answers) = mpsc::unbounded_channel();
    let topic = {
        let mut topics = bus.publications.lock();
        let topic = topics.entry(name.to_owned()).or_default();
        let mut state = topic.state.lock();
        state.askers.push((bus.next_id(), sender));
        let type_name = state.advert.as_ref().map_or("*", |advert| &advert.name);
        bus.registrar.set_wanted(Kind::Publisher, name, Some(type_name));
        topic.clone()
    };
    bus.publishing.notify_waiters();
    SubscriberQuery { bus: bus.clone(), name: name.to_owned(), topic, answers }
}

/// A pending query for the types that subscribers request; ends when dropped.
pub(super) struct SubscriberQuery {
    bus: Arc<Ros1BusState>,
    name: String,
    topic: Arc<TopicOut>,
    pub(super) answers: mpsc::UnboundedReceiver<WireType>,
}

impl Drop for SubscriberQuery {
    fn drop(&mut self) {
        self.answers.close();
        release(&self.bus, &self.name, &self.topic, |state| {
            state.askers.retain(|(_, asker)| !asker.is_closed());
        });
    }
}

impl TopicOut {
    fn add(
        &self,
        name: &str,
        id: i32,
        ours: &WireType,
        (qos, end): (QosProfile, EndpointOwner),
    ) -> Result<(), BusError> {
        let mut state = self.state.lock();
        match &state.advert {
            Some(before) if before.digest != ours.digest => {
                return Err(BusError::TypeMismatch {
                    what: format!("advertisement of {name}"),
                    theirs: before.to_string(),
                    ours: ours.to_string(),
                });
            }
            Some(_) => {}
            None => state.advert = Some(ours.clone()),
        }
        let local = LocalPublisher { end, qos, last: None };
        state.locals.insert(id, local);
        Ok(())
    }

    /// Returns the advertised type, and whether any publisher is latching.
    pub(super) fn advert(&self) -> Option<(WireType, bool)> {
        let state = self.state.lock();
        let latching = state.locals.values().any(|local| local.qos.is_latching());
        state.advert.clone().map(|advert| (advert, latching))
    }

    /// Forwards the type requested by a subscriber to the queries with a number above `told`; returns the number of the
    /// last one.
    pub(super) fn forward_requested_type(&self, asked: &WireType, told: Option<i32>) -> Option<i32> {
        let state = self.state.lock();
        let mut last = None;
        for (number, asker) in &state.askers {
            if told.is_none_or(|told| *number > told) {
                let _ = asker.send(asked.clone());
                last = Some(*number);
            }
        }
        last
    }

    /// Returns true if a subscriber that calls `requestTopic` is to be given our address.
    pub(super) fn is_open(&self) -> bool {
        let state = self.state.lock();
        state.advert.is_some() || !state.askers.is_empty()
    }

    /// Adds a subscriber, with all latched messages already queued for it; `None` if the topic is no longer advertised.
    pub(super) fn attach(&self, id: i32, name: &str) -> Option<Arc<Subscriber>> {
        let mut state = self.state.lock();
        state.advert.as_ref()?;
        let queue = state.locals.values().map(|local| local.qos.depth).max();
        let latched = state.locals.values().filter_map(|local| local.last.clone());
        let subscriber = Arc::new(Subscriber {
            id,
            peer: PeerId::new(name, id.unsigned_abs().into()),
            send_queue: SendQueue::new(queue.unwrap_or(1), latched),
            messages: AtomicU64::new(0),
            bytes: AtomicU64::new(0),
            closing: watch::Sender::new(false),
        });
        state.subscribers.push(subscriber.clone());
        self.matched.send_replace(state.matched_peers());
        Some(subscriber)
    }

    pub(super) fn detach(&self, subscriber: &Arc<Subscriber>) {
        let mut state = self.state.lock();
        state.subscribers.retain(|other| !Arc::ptr_eq(other, subscriber));
        self.matched.send_replace(state.matched_peers());
    }

    /// Sets the actions of this node that listen to the topic.
    pub(super) fn set_action_listeners(&self, actions: Vec<PeerId>) {
        let mut state = self.state.lock();
        if state.actions != actions {
            state.actions = actions;
            self.matched.send_replace(state.matched_peers());
        }
    }

    /// Returns the latched messages for a new subscription of this node.
    pub(super) fn latched_messages(&self, node: &str, end: EndpointOwner) -> Vec<SerializedMessage> {
        let state = self.state.lock();
        let Some(advert) = state.advert.clone().map(Arc::new) else {
            return Vec::new();
        };
        let heard = state.locals.iter().filter_map(|(id, local)| {
            let heard = end == EndpointOwner::Action || local.end == EndpointOwner::Action;
            Some(SerializedMessage {
                bytes: local.last.clone().filter(|_| heard)?,
                wire_type: advert.clone(),
                publisher: own_peer_id(node, *id),
                latching: true,
            })
        });
        heard.collect()
    }

    /// Publishes a message; returns true if an action of this node listens.
    fn publish(&self, id: i32, message: Bytes) -> bool {
        let mut state = self.state.lock();
        let Some(local) = state.locals.get_mut(&id) else {
            return false;
        };
        if local.qos.is_latching() {
            local.last = Some(message.clone());
        }
        let mut lost = DropTally::default();
        let size = message.len() as u64;
        for subscriber in &state.subscribers {
            subscriber.messages.fetch_add(1, Ordering::Relaxed);
            subscriber.bytes.fetch_add(size, Ordering::Relaxed);
            lost += subscriber.send_queue.push(message.clone());
        }
        self.dropped.add(lost);
        !state.actions.is_empty()
    }

    /// Stops publishing; queued messages are still sent.
    pub(super) fn retire(&self) {
        retire(&mut self.state.lock());
    }

    /// Waits until all subscribers are gone.
    pub(super) async fn wait_until_no_subscribers(&self) {
        let mut matched = self.matched.subscribe();
        let _ = matched.wait_for(|matched| matched.connected_count() == 0).await;
    }

    /// Returns the connected subscribers.
    pub(super) fn subscribers(&self) -> Vec<Arc<Subscriber>> {
        self.state.lock().subscribers.clone()
    }
}

impl State {
    fn matched_peers(&self) -> MatchedPeers {
        let subscribers = self.subscribers.iter().map(|subscriber| &subscriber.peer);
        let peers =
            subscribers.chain(&self.actions).map(|id| TopicPeer { id: id.clone(), connected: true, offer: None });
        MatchedPeers { peers: peers.collect(), refused: Vec::new() }
    }
}

fn retire(state: &mut State) {
    state.advert = None;
    state.locals.clear();
    state.actions.clear();
    for subscriber in &state.subscribers {
        subscriber.send_queue.close();
        subscriber.closing.send_replace(true);
    }
}

/// Applies `by` to remove something from a topic, and unregisters the topic once nothing is left of it.
fn release(bus: &Arc<Ros1BusState>, name: &str, topic: &Arc<TopicOut>, by: impl FnOnce(&mut State)) {
    {
        let mut topics = bus.publications.lock();
        let mut state = topic.state.lock();
        by(&mut state);
        if state.locals.is_empty() && state.advert.is_some() {
            retire(&mut state);
        }
        let current = topics.get(name).is_some_and(|t| Arc::ptr_eq(t, topic));
        if !current || !state.locals.is_empty() || !state.askers.is_empty() {
            return;
        }
        topics.remove(name);
        bus.registrar.set_wanted(Kind::Publisher, name, None);
    }
    let (bus_of_task, name) = (bus.clone(), name.to_owned());
    bus.spawn(async move {
        let registrar = &bus_of_task.registrar;
        let _ = registrar.sync(Kind::Publisher, &name, false).await;
    });
}

/// Returns the id of a publisher of this node.
fn own_peer_id(node: &str, id: i32) -> PeerId {
    PeerId::new(node, id.unsigned_abs().into())
}

/// One local publisher.
struct PublisherHandle {
    bus: Arc<Ros1BusState>,
    name: String,
    topic: Arc<TopicOut>,
    id: i32,
    end: EndpointOwner,
    of: Arc<WireType>,
    latching: bool,
}

impl Publisher for PublisherHandle {
    fn publish(&self, bytes: Bytes) {
        let heard = self.topic.publish(self.id, bytes.clone());
        if heard || self.end == EndpointOwner::Action {
            let message = SerializedMessage {
                bytes,
                wire_type: self.of.clone(),
                publisher: own_peer_id(&self.bus.node, self.id),
                latching: self.latching,
            };
            subscriptions::deliver_locally(&self.bus, &self.name, self.end, &message);
        }
    }

    fn matched_subscribers(&self) -> watch::Receiver<MatchedPeers> {
        self.topic.matched.subscribe()
    }

    fn dropped_count(&self) -> u64 {
        self.topic.dropped.get()
    }
}

impl Drop for PublisherHandle {
    fn drop(&mut self) {
        release(&self.bus, &self.name, &self.topic, |state| {
            state.locals.remove(&self.id);
        });
    }
}
