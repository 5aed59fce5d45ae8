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
use tokio::time::timeout_at;

use crate::INSIDE;
use crate::counted::CountingPublisher;
use crate::quality::PublisherOffer;
use crate::refusals::Refusals;
use crate::shared::BridgeShared;
use crate::topic_requests::TopicRequests;

/// Limits of messages kept while the topic is being advertised.
const WARM: RingBounds = RingBounds { messages: 256, bytes: 16 << 20 };

/// Factor of the waiting time for a registered node while nobody else is connected: on a busy machine rospy takes
/// seconds.
const ALONE: u32 = 10;

/// Receives events of an advertised topic.
pub(crate) trait PublisherEvents: Send + Sync + 'static {
    /// Called if the topic cannot be advertised.
    fn on_failed(&self, reason: &str);
    /// Called once for each subscriber that receives nothing because its quality of service is incompatible.
    fn on_refused(&self, reason: &str);
}

/// Deadlines of waiting for subscribers.
#[derive(Clone, Copy)]
struct WaitDeadlines {
    /// Deadline for missing subscribers while others are connected.
    some: Instant,
    /// Deadline for registered subscribers while nobody is connected.
    none: Instant,
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

/// Name and address of a node: another node may come with the same name.
type NodeAddress = (String, String);

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
            tokio::spawn(wait_for_subscribers(self.clone(), subscribers, self.wait_deadlines()));
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
        let (warm_up, now) = (self.shared.options.warm_up, Instant::now());
        WaitDeadlines { some: now + warm_up, none: now + warm_up * ALONE }
    }

    /// Returns the nodes registered as subscribers that are not connected. The bridge itself may be registered, but
    /// never connects; nor do subscribers with incompatible quality of service.
    fn missing_subscribers(&self, matched: &MatchedPeers) -> BTreeSet<NodeAddress> {
        let bus = &self.shared.bus;
        let graph = bus.graph().borrow().clone();
        let Some(nodes) = graph.topics.get(&self.topic) else {
            return BTreeSet::new();
        };
        nodes
            .subscribers
            .iter()
            .filter(|name| *name != bus.node() && *name != INSIDE)
            .filter(|name| !matched.has_node(name) && !is_refused(matched, name))
            .map(|name| {
                let address = graph.nodes.get(name).cloned();
                (name.clone(), address.unwrap_or_default())
            })
            .collect()
    }

    /// Returns whether all subscribers that should be connected are, and at least one is. An observing node does not
    /// count.
    fn is_complete(&self, matched: &MatchedPeers) -> bool {
        matched.connected_count_except(INSIDE) > 0 && self.missing_subscribers(matched).is_subset(&self.given_up.lock())
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

/// Returns whether an endpoint of this node does not match.
fn is_refused(matched: &MatchedPeers, node: &str) -> bool {
    let mut refused = matched.refused.iter();
    refused.any(|refusal| refusal.peer.node() == node)
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
    wait_for_subscribers(topic_publisher, subscribers, patience).await;
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

/// Waits until all subscribers that should be connected are, and at least one is; those that are too late miss the
/// queued messages. As long as nobody is connected, nobody waits for messages that a slow node would miss: it has more
/// time.
async fn wait_for_subscribers(
    topic_publisher: Arc<TopicPublisher>,
    mut subscribers: watch::Receiver<MatchedPeers>,
    patience: WaitDeadlines,
) {
    let mut in_time = wait_connected(&topic_publisher, &mut subscribers, patience.some).await;
    let is_slow = {
        let matched = subscribers.borrow();
        matched.connected_count_except(INSIDE) == 0 && !topic_publisher.missing_subscribers(&matched).is_empty()
    };
    if !in_time && is_slow {
        in_time = wait_connected(&topic_publisher, &mut subscribers, patience.none).await;
    }
    if !in_time {
        // They are not waited for again while they do not change.
        *topic_publisher.given_up.lock() = topic_publisher.missing_subscribers(&subscribers.borrow());
    }
    topic_publisher.go_live();
}

/// Returns whether all subscribers that should be connected are before `until`, or the topic has ended.
async fn wait_connected(
    topic_publisher: &TopicPublisher,
    subscribers: &mut watch::Receiver<MatchedPeers>,
    until: Instant,
) -> bool {
    let connected = async {
        loop {
            let matched = subscribers.borrow_and_update().clone();
            if topic_publisher.is_complete(&matched) {
                return;
            }
            if subscribers.changed().await.is_err() {
                return;
            }
        }
    };
    timeout_at(until.into(), connected).await.is_ok()
}

#[cfg(test)]
#[path = "topic_publisher_tests.rs"]
mod tests;
