//! One topic of the servant, subscribed to once however many clients listen.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock, Weak};
use std::time::Instant;

use parking_lot::Mutex;
use ros::bus::{Bus, Matched, Message, PeerId, Qos, Subscription, WireType};
use ros::schema::MessageType;
use tokio::task::AbortHandle;

use crate::Metrics;
use crate::names::any_definition;
use crate::quality::all_there_is;
use crate::refusals::Refusals;
use crate::sample::{Sample, TopicTypes};
use crate::shared::{Heard, Shared};
use crate::topic_requests::TopicRequests;

/// Who listens to a topic: a client's queue, a goal waiting for its result.
pub(crate) trait Listener: Send + Sync {
    /// A message; `replay` where it is an old one from a latching publisher. Must not block or call the fanout.
    fn sample(&self, sample: &Arc<Sample>, replay: bool);
    /// The topic cannot be subscribed to.
    fn failed(&self, reason: &str);
    /// A publisher of the topic is not heard, because it offers something else. Told once of each.
    fn refused(&self, _reason: &str) {}
}

/// The one subscription for all who ask the same of the topic's publishers.
pub(crate) struct Fanout {
    pub(crate) topic: String,
    /// What is asked of them.
    qos: Qos,
    shared: Weak<Shared>,
    types: Arc<TopicTypes>,
    /// What its messages answer, if anything.
    answers: Option<Arc<TopicRequests>>,
    state: Mutex<State>,
    pump: OnceLock<AbortHandle>,
    /// None of a topic of the bridge itself.
    _heard: Option<Heard>,
}

#[derive(Default)]
struct State {
    /// Replaced, not changed, so that a message is handed out without holding the lock.
    listeners: Arc<Listeners>,
    /// The last message of every latching publisher.
    latched: Vec<Arc<Sample>>,
    /// Publishers that are not heard.
    refusals: Refusals,
    failed: Option<String>,
}

type Listeners = Vec<(u64, Arc<dyn Listener>)>;

/// Keeps a listener on a fanout.
pub(crate) struct Listening {
    fanout: Arc<Fanout>,
    number: u64,
}

impl Listening {
    pub(crate) fn fanout(&self) -> &Arc<Fanout> {
        &self.fanout
    }
}

impl Drop for Listening {
    fn drop(&mut self) {
        let mut state = self.fanout.state.lock();
        let earlier = state.listeners.clone();
        let kept = earlier
            .iter()
            .filter(|(number, _)| *number != self.number)
            .cloned();
        state.listeners = Arc::new(kept.collect());
        drop(state);
        // Only now may the listener itself go.
        drop(earlier);
    }
}

impl Fanout {
    /// Subscribes in the background. `message_type` is what the first listener expects, where it knows.
    pub(crate) fn start(
        shared: &Arc<Shared>,
        topic: &str,
        message_type: Option<&MessageType>,
        qos: Qos,
    ) -> Arc<Fanout> {
        let fanout = Arc::new(Fanout {
            topic: topic.to_owned(),
            qos,
            shared: Arc::downgrade(shared),
            types: Arc::new(TopicTypes::new(shared.registry.clone())),
            answers: shared.answers_on(topic),
            state: Mutex::default(),
            pump: OnceLock::new(),
            _heard: Some(shared.hear_nodes()),
        });
        // Any digest: a publisher with another definition is read by its own, or its listeners are told of it; a
        // connection refused for it would only be silence.
        let name = message_type.map_or("*", MessageType::name);
        let of = any_definition(shared.bus.version(), name);
        let pump = tokio::spawn(pump(
            Arc::downgrade(&fanout),
            shared.bus.clone(),
            shared.metrics.clone(),
            topic.to_owned(),
            (of, qos),
        ));
        // Set once, here.
        let _ = fanout.pump.set(pump.abort_handle());
        fanout
    }

    /// A fanout for a topic of the bridge itself, which no node publishes.
    pub(crate) fn internal(shared: &Arc<Shared>, topic: &str) -> Arc<Fanout> {
        Arc::new(Fanout {
            topic: topic.to_owned(),
            qos: all_there_is(shared.options.bus_queue),
            shared: Arc::downgrade(shared),
            types: Arc::new(TopicTypes::new(shared.registry.clone())),
            answers: None,
            state: Mutex::default(),
            pump: OnceLock::new(),
            _heard: None,
        })
    }

    /// Who came last of those who listen now; no two listeners of any fanout have the same number.
    pub(crate) fn newest_listener(&self) -> Option<u64> {
        let state = self.state.lock();
        state.listeners.last().map(|(number, _)| *number)
    }

    pub(crate) fn is_internal(&self) -> bool {
        self.pump.get().is_none()
    }

    /// Whether it asks this of the topic's publishers, or has none of nodes.
    pub(crate) fn serves(&self, qos: &Qos) -> bool {
        self.is_internal() || self.qos == *qos
    }

    /// Whether newcomers are given what was published before.
    pub(crate) fn keeps(&self) -> bool {
        self.qos.is_latching()
    }

    /// Adds a listener, which first hears what latching publishers last said.
    pub(crate) fn listen(self: &Arc<Self>, listener: Arc<dyn Listener>) -> Listening {
        static NUMBER: AtomicU64 = AtomicU64::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let mut state = self.state.lock();
        if let Some(reason) = &state.failed {
            listener.failed(reason);
        }
        for reason in state.refusals.known() {
            listener.refused(reason);
        }
        self.replay_to(&mut state, listener.as_ref());
        let mut listeners = Listeners::clone(&state.listeners);
        listeners.push((number, listener));
        state.listeners = Arc::new(listeners);
        Listening {
            fanout: self.clone(),
            number,
        }
    }

    /// Lets a listener hear once more what latching publishers last said.
    pub(crate) fn replay(&self, listener: &dyn Listener) {
        self.replay_to(&mut self.state.lock(), listener);
    }

    fn replay_to(&self, state: &mut State, listener: &dyn Listener) {
        if state.latched.is_empty() {
            return;
        }
        // A publisher that is gone has taken its message with it.
        if let Some(shared) = self.shared.upgrade() {
            let graph = shared.bus.graph().borrow().clone();
            state.latched.retain(|sample| {
                sample.local || graph.publishes(sample.publisher.node(), &self.topic)
            });
        }
        for sample in &state.latched {
            listener.sample(sample, true);
        }
    }

    /// Hands a message to every listener.
    pub(crate) fn deliver(&self, message: Message, local: bool) {
        let Some(shared) = self.shared.upgrade() else {
            return;
        };
        let sample = match Sample::new(message, local, self.types.clone(), &shared.options) {
            Ok(sample) => Arc::new(sample),
            Err(full) => {
                tracing::debug!(topic = %self.topic, %full, "a message is left out");
                shared.metrics.drops.add(&self.topic, 1);
                return shared.metrics.dropped.add(1);
            }
        };
        let listeners = {
            let mut state = self.state.lock();
            if sample.latching && self.keeps() {
                state
                    .latched
                    .retain(|other| other.publisher != sample.publisher);
                state.latched.push(sample.clone());
            }
            state.listeners.clone()
        };
        for (_, listener) in listeners.iter() {
            listener.sample(&sample, false);
        }
    }

    /// A client that latched a message here publishes no longer.
    pub(crate) fn forget(&self, publisher: &PeerId) {
        self.state
            .lock()
            .latched
            .retain(|sample| sample.publisher != *publisher);
    }

    /// Tells how long a request took that this message answers. A latched message tells a state, and answers nothing.
    fn answers(&self, message: &Message) {
        let Some(requests) = self.answers.as_ref().filter(|_| !message.latching) else {
            return;
        };
        let of = self.types.find(&message.wire_type).ok();
        let took = of.and_then(|of| requests.answered(&of, &message.bytes, Instant::now()));
        if let (Some(took), Some(shared)) = (took, self.shared.upgrade()) {
            shared.options.called.tell(Some(took));
        }
    }

    /// Tells all listeners of publishers that are not heard.
    fn note_refused(&self, matched: &Matched) {
        let (new, listeners) = {
            let mut state = self.state.lock();
            let new = state.refusals.update(matched);
            (new, state.listeners.clone())
        };
        for reason in &new {
            for (_, listener) in listeners.iter() {
                listener.refused(reason);
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
            listener.failed(&reason);
        }
        // The next to subscribe tries anew.
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
    (of, qos): (WireType, Qos),
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
    // Those that are there already.
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
            fanout.note_refused(&now);
            continue;
        };
        metrics.received.add(1);
        // From an action of another client.
        let local = message.publisher.node() == own;
        if !local {
            fanout.answers(&message);
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
