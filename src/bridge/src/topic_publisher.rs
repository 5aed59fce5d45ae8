//! A topic that a client publishes on.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{Matched, Message, PeerId, WireType};
use ros::ring::{Bounds, Ring};
use ros::schema::MessageType;
use ros::sizes::Sizes;
use tokio::sync::watch;
use tokio::time::timeout_at;

use crate::INSIDE;
use crate::counted::Counted;
use crate::quality::Offer;
use crate::refusals::Refusals;
use crate::shared::Shared;
use crate::topic_requests::TopicRequests;

/// Kept while the topic is being advertised.
const WARM: Bounds = Bounds {
    messages: 256,
    bytes: 16 << 20,
};

/// So many times as long a node is waited for that has registered, where nobody else is connected: on a busy machine rospy takes seconds.
const ALONE: u32 = 10;

/// Whoever publishes, for what must be known of the topic.
pub(crate) trait Notified: Send + Sync + 'static {
    /// It cannot be advertised.
    fn failed(&self, reason: &str);
    /// A subscriber hears nothing, because it asks for something else. Told once of each.
    fn refused(&self, reason: &str);
}

/// Until when subscribers are waited for.
#[derive(Clone, Copy)]
struct Patience {
    /// Those that are missing while others are connected.
    some: Instant,
    /// Those that are registered, while nobody is connected.
    none: Instant,
}

/// One client's advertisement of one topic.
pub(crate) struct TopicPublisher {
    pub(crate) topic: String,
    pub(crate) message_type: Arc<MessageType>,
    pub(crate) offer: Offer,
    wire_type: Arc<WireType>,
    sizes: Arc<Sizes>,
    /// Tells this topic_publisher's latched message from others'.
    pub(crate) id: PeerId,
    /// What its messages are where they are requests.
    requests: Option<Arc<TopicRequests>>,
    shared: Arc<Shared>,
    /// The last message, where it latches.
    last: Mutex<Option<Bytes>>,
    /// Subscribers that were waited for in vain: they have another definition of the type, or nobody answers there.
    given_up: Mutex<BTreeSet<Node>>,
    state: Mutex<State>,
}

/// A node's name and address: of the same name another may come.
type Node = (String, String);

enum State {
    /// Not yet advertised, or a node that the Master names as subscriber has not connected yet: messages wait a
    /// moment, since clients publish right behind their `advertise`, or as soon as rosapi names a subscriber.
    Warming {
        waiting: Ring<Bytes>,
        publisher: Option<Counted>,
    },
    Live {
        publisher: Counted,
        /// The graph in which nobody is missing but those given up.
        settled: u64,
    },
    Failed,
}

impl State {
    fn warming(publisher: Option<Counted>) -> State {
        State::Warming {
            waiting: Ring::new(WARM),
            publisher,
        }
    }
}

impl TopicPublisher {
    /// Advertises in the background.
    pub(crate) fn open(
        shared: &Arc<Shared>,
        topic: &str,
        message_type: Arc<MessageType>,
        offer: Offer,
        notified: Arc<dyn Notified>,
    ) -> Arc<TopicPublisher> {
        let wire_type = WireType::of(&message_type);
        let topic_publisher = Arc::new(TopicPublisher {
            topic: topic.to_owned(),
            sizes: shared.inputs.of(topic, Some(&message_type)),
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
        shared.add_outlet(&topic_publisher);
        // Holds the topic_publisher until what was published at once has been sent, even if the client is gone by then.
        tokio::spawn(warm_up(topic_publisher.clone(), wire_type, notified));
        topic_publisher
    }

    pub(crate) fn publish(self: &Arc<Self>, bytes: Bytes) {
        self.shared.metrics.published.add(1);
        self.sizes.note(&bytes);
        if self.shared.hears_nodes() {
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
            let subscribers = publisher.matched();
            if let State::Live { publisher, .. } =
                std::mem::replace(&mut *state, State::warming(None))
            {
                *state = State::warming(Some(publisher));
            }
            tokio::spawn(settle(self.clone(), subscribers, self.patience()));
        }
        match &mut *state {
            State::Live { publisher, .. } => {
                // Not of what waits for connections: that is no time of the servant.
                if let Some(requests) = &self.requests {
                    let shared = &self.shared;
                    let heard = requests.is_heard(|topic| !shared.live_fanouts(topic).is_empty());
                    let now = Instant::now();
                    let unanswered = requests.asked(&self.message_type, &bytes, now, heard);
                    (0..unanswered).for_each(|_| shared.options.called.tell(None));
                }
                publisher.publish(bytes);
            }
            State::Failed => {}
            State::Warming { waiting, .. } => {
                let lost = waiting.push(bytes);
                let metrics = &self.shared.metrics;
                metrics.drops.add(&self.topic, lost.messages);
                metrics.lost(lost);
            }
        }
    }

    /// What a newcomer is given.
    pub(crate) fn latched(&self) -> Option<Message> {
        self.last.lock().clone().map(|bytes| self.message(bytes))
    }

    fn message(&self, bytes: Bytes) -> Message {
        Message {
            bytes,
            wire_type: self.wire_type.clone(),
            publisher: self.id.clone(),
            latching: self.offer.latch,
        }
    }

    /// Whether somebody is missing who was not in the graph of generation `settled`, which becomes the present one if
    /// not.
    fn is_incomplete(&self, publisher: &Counted, settled: &mut u64) -> bool {
        let generation = self.shared.bus.graph().borrow().generation;
        if generation == *settled {
            return false;
        }
        let missing = self.missing(&publisher.matched().borrow());
        let mut given_up = self.given_up.lock();
        // Who has gone meanwhile may come back with the right type.
        given_up.retain(|node| missing.contains(node));
        let incomplete = !missing.is_subset(&given_up);
        if !incomplete {
            *settled = generation;
        }
        incomplete
    }

    /// Until when subscribers are waited for from now on.
    fn patience(&self) -> Patience {
        let (warm_up, now) = (self.shared.options.warm_up, Instant::now());
        Patience {
            some: now + warm_up,
            none: now + warm_up * ALONE,
        }
    }

    /// Nodes that the graph names as subscribers, and that are not connected. The bridge itself may be among those
    /// that are named, but never connects; nor does who asks for something else.
    fn missing(&self, matched: &Matched) -> BTreeSet<Node> {
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

    /// Whether all are connected who should be, at least one. Who only observes what flows is not one.
    fn is_complete(&self, matched: &Matched) -> bool {
        matched.connected_beside(INSIDE) > 0
            && self.missing(matched).is_subset(&self.given_up.lock())
    }

    /// Sends what waits, in order, and from now on at once.
    fn go_live(&self) {
        let settled = self.shared.bus.graph().borrow().generation;
        let mut state = self.state.lock();
        let State::Warming {
            waiting, publisher, ..
        } = &mut *state
        else {
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
        self.shared.forget_outlet(self);
    }
}

/// Whether an end of this node's cannot match.
fn is_refused(matched: &Matched, node: &str) -> bool {
    let mut refused = matched.refused.iter();
    refused.any(|refusal| refusal.peer.node() == node)
}

async fn warm_up(topic_publisher: Arc<TopicPublisher>, of: WireType, notified: Arc<dyn Notified>) {
    let shared = topic_publisher.shared.clone();
    let patience = topic_publisher.patience();
    let (topic, qos) = (&topic_publisher.topic, topic_publisher.offer.qos);
    let publisher = match shared.bus.advertise(topic, of, qos).await {
        Ok(publisher) => Counted::new(publisher, topic, shared.metrics.clone()),
        Err(error) => {
            *topic_publisher.state.lock() = State::Failed;
            return notified.failed(&error.to_string());
        }
    };
    let subscribers = publisher.matched();
    tokio::spawn(tell_refused(subscribers.clone(), notified));
    if let State::Warming {
        publisher: held, ..
    } = &mut *topic_publisher.state.lock()
    {
        *held = Some(publisher);
    }
    settle(topic_publisher, subscribers, patience).await;
}

/// Tells of subscribers that ask for something else, for as long as the topic is advertised.
async fn tell_refused(mut subscribers: watch::Receiver<Matched>, notified: Arc<dyn Notified>) {
    let mut refusals = Refusals::default();
    loop {
        let new = refusals.update(&subscribers.borrow_and_update());
        for reason in new {
            notified.refused(&reason);
        }
        if subscribers.changed().await.is_err() {
            return;
        }
    }
}

/// Waits until all are connected who should be, at least one; those out of patience get nothing of what waits. As long as nobody at all is
/// connected, nobody waits either for what a slow node lacks: it has more time.
async fn settle(
    topic_publisher: Arc<TopicPublisher>,
    mut subscribers: watch::Receiver<Matched>,
    patience: Patience,
) {
    let mut in_time = connected(&topic_publisher, &mut subscribers, patience.some).await;
    let is_slow = {
        let matched = subscribers.borrow();
        matched.connected_beside(INSIDE) == 0 && !topic_publisher.missing(&matched).is_empty()
    };
    if !in_time && is_slow {
        in_time = connected(&topic_publisher, &mut subscribers, patience.none).await;
    }
    if !in_time {
        // Not waited for again while they are what they are.
        *topic_publisher.given_up.lock() = topic_publisher.missing(&subscribers.borrow());
    }
    topic_publisher.go_live();
}

/// Whether all are connected who should be before this time, or the topic has ended.
async fn connected(
    topic_publisher: &TopicPublisher,
    subscribers: &mut watch::Receiver<Matched>,
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
