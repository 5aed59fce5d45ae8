//! One subscription per topic of the servant, shared by all listening clients.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock, Weak};
use std::time::Instant;

use parking_lot::Mutex;
use ros::bus::{Bus, MatchedPeers, PeerId, QosProfile, SerializedMessage, Subscription, WireType};
use ros::schema::MessageType;
use tokio::task::AbortHandle;

use crate::Metrics;
use crate::names::wildcard_type;
use crate::quality::default_subscription_qos;
use crate::refusals::Refusals;
use crate::sample::{TopicSample, TopicTypes};
use crate::shared::{BridgeShared, NodeTopicGuard};
use crate::topic_requests::TopicRequests;

/// A listener on a topic: a client's queue, a goal waiting for its result.
pub(crate) trait Listener: Send + Sync {
    /// Called for each message; `replay` if it is an old one of a latching publisher. Must not block or call the
    /// fanout.
    fn on_sample(&self, sample: &Arc<TopicSample>, replay: bool);
    /// Called if the topic cannot be subscribed to.
    fn on_failed(&self, reason: &str);
    /// Called once for each publisher of the topic that does not match because it offers something else.
    fn on_refused(&self, _reason: &str) {}
}

/// The subscription shared by all listeners that request the same quality of service.
pub(crate) struct Fanout {
    pub(crate) topic: String,
    /// Quality of service requested from publishers.
    qos: QosProfile,
    shared: Weak<BridgeShared>,
    types: Arc<TopicTypes>,
    /// Requests that messages of this topic answer, if any.
    answers: Option<Arc<TopicRequests>>,
    state: Mutex<State>,
    pump: OnceLock<AbortHandle>,
    /// `None` for topics of the bridge itself.
    _heard: Option<NodeTopicGuard>,
}

#[derive(Default)]
struct State {
    /// Replaced instead of changed, so that messages are delivered without holding the lock.
    listeners: Arc<Listeners>,
    /// The last message of every latching publisher.
    latched: Vec<Arc<TopicSample>>,
    /// Publishers that do not match.
    refusals: Refusals,
    failed: Option<String>,
}

type Listeners = Vec<(u64, Arc<dyn Listener>)>;

/// Keeps a listener registered on a fanout.
pub(crate) struct ListenerGuard {
    fanout: Arc<Fanout>,
    number: u64,
}

impl ListenerGuard {
    pub(crate) fn fanout(&self) -> &Arc<Fanout> {
        &self.fanout
    }
}

impl Drop for ListenerGuard {
    fn drop(&mut self) {
        let mut state = self.fanout.state.lock();
        let earlier = state.listeners.clone();
        let kept = earlier.iter().filter(|(number, _)| *number != self.number).cloned();
        state.listeners = Arc::new(kept.collect());
        drop(state);
        // Only now may the listener itself be dropped.
        drop(earlier);
    }
}

impl Fanout {
    /// Subscribes in the background. `message_type` is the type expected by the first listener, if known.
    pub(crate) fn start(
        shared: &Arc<BridgeShared>,
        topic: &str,
        message_type: Option<&MessageType>,
        qos: QosProfile,
    ) -> Arc<Fanout> {
        let fanout = Arc::new(Fanout {
            topic: topic.to_owned(),
            qos,
            shared: Arc::downgrade(shared),
            types: Arc::new(TopicTypes::new(shared.registry.clone())),
            answers: shared.answers_on(topic),
            state: Mutex::default(),
            pump: OnceLock::new(),
            _heard: Some(shared.count_node_listener()),
        });
        // Any digest: a publisher with another definition is decoded by its own, or its listeners are told; refusing
        // the connection would only lead to silence.
        let name = message_type.map_or("*", MessageType::name);
        let of = wildcard_type(shared.bus.version(), name);
        let pump = tokio::spawn(pump(
            Arc::downgrade(&fanout),
            shared.bus.clone(),
            shared.metrics.clone(),
            topic.to_owned(),
            (of, qos),
        ));
        // Only set here.
        let _ = fanout.pump.set(pump.abort_handle());
        fanout
    }

    /// Creates a fanout for a topic of the bridge itself, which no node publishes.
    pub(crate) fn internal(shared: &Arc<BridgeShared>, topic: &str) -> Arc<Fanout> {
        Arc::new(Fanout {
            topic: topic.to_owned(),
            qos: default_subscription_qos(shared.options.bus_queue),
            shared: Arc::downgrade(shared),
            types: Arc::new(TopicTypes::new(shared.registry.clone())),
            answers: None,
            state: Mutex::default(),
            pump: OnceLock::new(),
            _heard: None,
        })
    }

    /// Returns the number of the newest current listener; numbers are unique across all fanouts.
    pub(crate) fn newest_listener(&self) -> Option<u64> {
        let state = self.state.lock();
        state.listeners.last().map(|(number, _)| *number)
    }

    pub(crate) fn is_internal(&self) -> bool {
        self.pump.get().is_none()
    }

    /// Returns whether it requests this quality of service from publishers, or has none in nodes.
    pub(crate) fn serves_qos(&self, qos: &QosProfile) -> bool {
        self.is_internal() || self.qos == *qos
    }

    /// Returns whether new listeners receive messages published before.
    pub(crate) fn keeps_latched(&self) -> bool {
        self.qos.is_latching()
    }

    /// Adds a listener, which first receives the last messages of latching publishers.
    pub(crate) fn listen(self: &Arc<Self>, listener: Arc<dyn Listener>) -> ListenerGuard {
        static NUMBER: AtomicU64 = AtomicU64::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let mut state = self.state.lock();
        if let Some(reason) = &state.failed {
            listener.on_failed(reason);
        }
        for reason in state.refusals.reasons() {
            listener.on_refused(reason);
        }
        self.replay_to(&mut state, listener.as_ref());
        let mut listeners = Listeners::clone(&state.listeners);
        listeners.push((number, listener));
        state.listeners = Arc::new(listeners);
        ListenerGuard { fanout: self.clone(), number }
    }

    /// Delivers the last messages of latching publishers to a listener again.
    pub(crate) fn replay(&self, listener: &dyn Listener) {
        self.replay_to(&mut self.state.lock(), listener);
    }

    fn replay_to(&self, state: &mut State, listener: &dyn Listener) {
        if state.latched.is_empty() {
            return;
        }
        // Messages of publishers that are gone are removed.
        if let Some(shared) = self.shared.upgrade() {
            let graph = shared.bus.graph().borrow().clone();
            state.latched.retain(|sample| sample.local || graph.publishes(sample.publisher.node(), &self.topic));
        }
        for sample in &state.latched {
            listener.on_sample(sample, true);
        }
    }

    /// Delivers a message to every listener.
    pub(crate) fn deliver(&self, message: SerializedMessage, local: bool) {
        let Some(shared) = self.shared.upgrade() else {
            return;
        };
        let sample = match TopicSample::new(message, local, self.types.clone(), &shared.options) {
            Ok(sample) => Arc::new(sample),
            Err(full) => {
                tracing::debug!(topic = %self.topic, %full, "a message was dropped");
                shared.metrics.drops.add(&self.topic, 1);
                return shared.metrics.dropped.add(1);
            }
        };
        let listeners = {
            let mut state = self.state.lock();
            if sample.latching && self.keeps_latched() {
                state.latched.retain(|other| other.publisher != sample.publisher);
                state.latched.push(sample.clone());
            }
            state.listeners.clone()
        };
        for (_, listener) in listeners.iter() {
            listener.on_sample(&sample, false);
        }
    }

    /// Removes the message latched by a client that no longer publishes.
    pub(crate) fn forget_publisher(&self, publisher: &PeerId) {
        self.state.lock().latched.retain(|sample| sample.publisher != *publisher);
    }

    /// Records the duration of the request that this message answers. A latched message is a state, and answers
    /// nothing.
    fn record_answer(&self, message: &SerializedMessage) {
        let Some(requests) = self.answers.as_ref().filter(|_| !message.latching) else {
            return;
        };
        let of = self.types.find(&message.wire_type).ok();
        let took = of.and_then(|of| requests.record_answer(&of, &message.bytes, Instant::now()));
        if let (Some(took), Some(shared)) = (took, self.shared.upgrade()) {
            shared.options.called.record(Some(took));
        }
    }

    /// Reports publishers that do not match to all listeners.
    fn report_refusals(&self, matched: &MatchedPeers) {
        let (new, listeners) = {
            let mut state = self.state.lock();
            let new = state.refusals.update(matched);
            (new, state.listeners.clone())
        };
        for reason in &new {
            for (_, listener) in listeners.iter() {
                listener.on_refused(reason);
            }
        }
    }

    fn fail(&self, reason: String) {
        let listeners = {
            let mut state = self.state.lock();
            state.failed = Some(reason.clone());
            state.listeners.clone()
        };
        for (_, listener) in listeners.iter() {
            listener.on_failed(&reason);
        }
        // The next subscription tries again.
        if let Some(shared) = self.shared.upgrade() {
            shared.forget_fanout(self);
        }
    }
}

impl Drop for Fanout {
    fn drop(&mut self) {
        if let Some(pump) = self.pump.get() {
            pump.abort();
        }
        if let Some(shared) = self.shared.upgrade() {
            shared.forget_fanout(self);
        }
    }
}

/// Moves messages from the bus to the fanout until either is gone. Owns nothing of the bridge, which may end meanwhile.
async fn pump(
    fanout: Weak<Fanout>,
    bus: Arc<dyn Bus>,
    metrics: Arc<Metrics>,
    topic: String,
    (of, qos): (WireType, QosProfile),
) {
    let mut subscription: Subscription = match bus.subscribe(&topic, of, qos).await {
        Ok(subscription) => subscription,
        Err(error) => {
            if let Some(fanout) = fanout.upgrade() {
                fanout.fail(error.to_string());
            }
            return;
        }
    };
    let own = bus.node().to_owned();
    drop(bus);
    let mut dropped = 0;
    let mut matched = subscription.matched.clone();
    // Includes those that are there already.
    matched.mark_changed();
    let mut watched = true;
    loop {
        let next = tokio::select! {
            next = subscription.messages.recv() => match next {
                Some(message) => Some(message),
                None => return,
            },
            changed = matched.changed(), if watched => {
                watched = changed.is_ok();
                None
            }
        };
        let Some(fanout) = fanout.upgrade() else {
            return;
        };
        let Some(message) = next else {
            let now = matched.borrow_and_update().clone();
            fanout.report_refusals(&now);
            continue;
        };
        metrics.received.add(1);
        // From another client's action.
        let local = message.publisher.node() == own;
        if !local {
            fanout.record_answer(&message);
        }
        fanout.deliver(message, local);
        let now_dropped = subscription.dropped.get();
        if now_dropped > dropped {
            metrics.bus_dropped.add(now_dropped - dropped);
            metrics.drops.add(&fanout.topic, now_dropped - dropped);
            dropped = now_dropped;
        }
    }
}
