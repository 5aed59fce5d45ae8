//! A topic on which a client publishes.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{MatchedPeers, PeerId, SerializedMessage, WireType};
use ros::ring::{Ring, RingBounds};
use ros::schema::MessageType;
use ros::sizes::SizeCounters;
use tokio::sync::watch;

use crate::counted_publisher::CountingPublisher;
use crate::quality::PublisherOffer;
use crate::refusals::Refusals;
use crate::shared::BridgeShared;
use crate::subscribers::{NodeAddress, WaitDeadlines, find_missing_subscribers, wait_for_subscribers};
use crate::topic_requests::TopicRequests;

/// Limits of messages kept while the topic is being advertised.
const WARM: RingBounds = RingBounds { messages: 256, bytes: 16 << 20 };

/// Receives events of an advertised topic.
pub(crate) trait PublisherEvents: Send + Sync + 'static {
    /// Called if the topic cannot be advertised.
    fn on_failed(&self, reason: &str);
    /// Called once for each subscriber that receives nothing because its quality of service is incompatible.
    fn on_refused(&self, reason: &str);
}

/// Advertisement of one topic by one client.
pub(crate) struct TopicPublisher {
    pub(crate) topic: String,
    pub(crate) message_type: Arc<MessageType>,
    pub(crate) offer: PublisherOffer,
    wire_type: Arc<WireType>,
    sizes: Arc<SizeCounters>,
    /// Distinguishes this topic_publisher's latched message from others'.
    pub(crate) id: PeerId,
    /// Tracker of requests, if its messages are requests.
    requests: Option<Arc<TopicRequests>>,
    shared: Arc<BridgeShared>,
    /// The last message, if it latches.
    last: Mutex<Option<Bytes>>,
    /// Subscribers that were waited for in vain: they have another definition of the type, or do not respond.
    given_up: Mutex<BTreeSet<NodeAddress>>,
    state: Mutex<State>,
}

enum State {
    /// Not advertised yet, or a node registered as subscriber is not connected yet: messages wait a moment, since
    /// clients publish right after their `advertise`, or as soon as rosapi lists a subscriber.
    Warming {
        waiting: Ring<Bytes>,
        publisher: Option<CountingPublisher>,
    },
    Live {
        publisher: CountingPublisher,
        /// Generation of the graph in which no subscriber is missing, except those given up.
        settled: u64,
    },
    Failed,
}

impl State {
    fn warming(publisher: Option<CountingPublisher>) -> State {
        State::Warming { waiting: Ring::new(WARM), publisher }
    }
}

impl TopicPublisher {
    /// Advertises in the background.
    pub(crate) fn open(
        shared: &Arc<BridgeShared>,
        topic: &str,
        message_type: Arc<MessageType>,
        offer: PublisherOffer,
        notified: Arc<dyn PublisherEvents>,
    ) -> Arc<TopicPublisher> {
        let wire_type = WireType::from_message(&message_type);
        let topic_publisher = Arc::new(TopicPublisher {
            topic: topic.to_owned(),
            sizes: shared.inputs.for_input(topic, Some(&message_type)),
            message_type,
            offer,
            wire_type: Arc::new(wire_type.clone()),
            id: PeerId::new(format!("client#{}", shared.next_number()), 0),
            requests: shared.requests_on(topic),
            shared: shared.clone(),
            last: Mutex::default(),
            given_up: Mutex::default(),
            state: Mutex::new(State::warming(None)),
        });
        shared.add_publisher(&topic_publisher);
        // Holds the topic_publisher until the first messages have been sent, even if the client is gone by then.
        tokio::spawn(warm_up(topic_publisher.clone(), wire_type, notified));
        topic_publisher
    }

    pub(crate) fn publish(self: &Arc<Self>, bytes: Bytes) {
        self.shared.metrics.published.add(1);
        self.sizes.record(&bytes);
        if self.shared.has_node_listeners() {
            self.shared.metrics.asked.add(1);
        }
        if self.offer.latch {
            *self.last.lock() = Some(bytes.clone());
        }
        for fanout in self.shared.live_fanouts(&self.topic) {
            fanout.deliver(self.message(bytes.clone()), true);
        }
        let mut state = self.state.lock();
        if let State::Live { publisher, settled } = &mut *state
            && self.is_incomplete(publisher, settled)
        {
            let subscribers = publisher.match_events();
            if let State::Live { publisher, .. } = std::mem::replace(&mut *state, State::warming(None)) {
                *state = State::warming(Some(publisher));
            }
            tokio::spawn(go_live_once_connected(self.clone(), subscribers, self.wait_deadlines()));
        }
        match &mut *state {
            State::Live { publisher, .. } => {
                // Not for messages that wait for connections: that time is not the servant's.
                if let Some(requests) = &self.requests {
                    let shared = &self.shared;
                    let heard = requests.has_listener(|topic| !shared.live_fanouts(topic).is_empty());
                    let now = Instant::now();
                    let unanswered = requests.record_request(&self.message_type, &bytes, now, heard);
                    (0..unanswered).for_each(|_| shared.options.called.record(None));
                }
                publisher.publish(bytes);
            }
            State::Failed => {}
            State::Warming { waiting, .. } => {
                let lost = waiting.push(bytes);
                let metrics = &self.shared.metrics;
                metrics.drops.add(&self.topic, lost.messages);
                metrics.record_lost(lost);
            }
        }
    }

    /// Returns the message for new subscribers.
    pub(crate) fn latched_message(&self) -> Option<SerializedMessage> {
        self.last.lock().clone().map(|bytes| self.message(bytes))
    }

    fn message(&self, bytes: Bytes) -> SerializedMessage {
        SerializedMessage {
            bytes,
            wire_type: self.wire_type.clone(),
            publisher: self.id.clone(),
            latching: self.offer.latch,
        }
    }

    /// Returns whether a subscriber is missing that was not in the graph of generation `settled`; if not, sets
    /// `settled` to the present generation.
    fn is_incomplete(&self, publisher: &CountingPublisher, settled: &mut u64) -> bool {
        let generation = self.shared.bus.graph().borrow().generation;
        if generation == *settled {
            return false;
        }
        let missing = self.missing_subscribers(&publisher.match_events().borrow());
        let mut given_up = self.given_up.lock();
        // A node that has left may come back with the right type.
        given_up.retain(|node| missing.contains(node));
        let incomplete = !missing.is_subset(&given_up);
        if !incomplete {
            *settled = generation;
        }
        incomplete
    }

    /// Returns the deadlines of waiting for subscribers, from now on.
    fn wait_deadlines(&self) -> WaitDeadlines {
        WaitDeadlines::start(self.shared.options.warm_up)
    }

    /// Returns the subscribers that are not connected.
    fn missing_subscribers(&self, matched: &MatchedPeers) -> BTreeSet<NodeAddress> {
        find_missing_subscribers(&*self.shared.bus, &self.topic, matched)
    }

    /// Sends the queued messages, in order, and from now on all at once.
    fn go_live(&self) {
        let settled = self.shared.bus.graph().borrow().generation;
        let mut state = self.state.lock();
        let State::Warming { waiting, publisher, .. } = &mut *state else {
            return;
        };
        let Some(publisher) = publisher.take() else {
            return;
        };
        for bytes in waiting {
            publisher.publish(bytes);
        }
        *state = State::Live { publisher, settled };
    }
}

impl Drop for TopicPublisher {
    fn drop(&mut self) {
        self.shared.forget_publisher(self);
    }
}

async fn warm_up(topic_publisher: Arc<TopicPublisher>, of: WireType, notified: Arc<dyn PublisherEvents>) {
    let shared = topic_publisher.shared.clone();
    let patience = topic_publisher.wait_deadlines();
    let (topic, qos) = (&topic_publisher.topic, topic_publisher.offer.qos);
    let publisher = match shared.bus.advertise(topic, of, qos).await {
        Ok(publisher) => CountingPublisher::new(publisher, topic, shared.metrics.clone()),
        Err(error) => {
            *topic_publisher.state.lock() = State::Failed;
            return notified.on_failed(&error.to_string());
        }
    };
    let subscribers = publisher.match_events();
    tokio::spawn(report_refusals(subscribers.clone(), notified));
    if let State::Warming { publisher: held, .. } = &mut *topic_publisher.state.lock() {
        *held = Some(publisher);
    }
    go_live_once_connected(topic_publisher, subscribers, patience).await;
}

/// Reports incompatible subscribers for as long as the topic is advertised.
async fn report_refusals(mut subscribers: watch::Receiver<MatchedPeers>, notified: Arc<dyn PublisherEvents>) {
    let mut refusals = Refusals::default();
    loop {
        let new = refusals.update(&subscribers.borrow_and_update());
        for reason in new {
            notified.on_refused(&reason);
        }
        if subscribers.changed().await.is_err() {
            return;
        }
    }
}

/// Sends the queued messages once the subscribers are connected; those that are too late miss them.
async fn go_live_once_connected(
    topic_publisher: Arc<TopicPublisher>,
    mut subscribers: watch::Receiver<MatchedPeers>,
    patience: WaitDeadlines,
) {
    let missing = |matched: &MatchedPeers| {
        let given_up = topic_publisher.given_up.lock();
        let mut missing = topic_publisher.missing_subscribers(matched);
        missing.retain(|node| !given_up.contains(node));
        missing
    };
    let late = wait_for_subscribers(&mut subscribers, patience, missing).await;
    // They are not waited for again while they do not change.
    topic_publisher.given_up.lock().extend(late);
    topic_publisher.go_live();
}

#[cfg(test)]
#[path = "topic_publisher_tests.rs"]
mod tests;
