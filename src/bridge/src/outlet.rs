//! A topic that a client publishes on.

use std::collections::VecDeque;
use std::sync::{Arc, Weak};
use std::time::Instant;

use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{AdvertiseOptions, Message, Publisher, WireType};
use ros::schema::MessageType;
use tokio::sync::watch;
use tokio::time::timeout_at;

use crate::bridge::Shared;

/// Messages kept while the topic is being advertised, and their bytes.
const WARM_MESSAGES: usize = 256;
const WARM_BYTES: usize = 16 << 20;

/// One client's advertisement of one topic.
pub(crate) struct Outlet {
    pub(crate) topic: String,
    pub(crate) message_type: Arc<MessageType>,
    pub(crate) latch: bool,
    wire_type: Arc<WireType>,
    /// Tells this outlet's latched message from others'.
    pub(crate) name: Arc<str>,
    shared: Arc<Shared>,
    /// The last message, where it latches.
    last: Mutex<Option<Bytes>>,
    /// How many nodes are connected; follows the publisher once there is one.
    connected: watch::Sender<usize>,
    state: Mutex<State>,
}

enum State {
    /// Not yet advertised, or no subscriber has connected yet: messages wait a moment, since clients publish
    /// right behind their `advertise`.
    Warming { waiting: VecDeque<Bytes>, bytes: usize },
    Live(Box<dyn Publisher>),
    Failed,
}

impl Outlet {
    /// Advertises in the background; `failed` is told if that does not succeed.
    pub(crate) fn open(
        shared: &Arc<Shared>,
        topic: &str,
        message_type: Arc<MessageType>,
        latch: bool,
        queue: usize,
        failed: impl FnOnce(String) + Send + 'static,
    ) -> Arc<Outlet> {
        let wire_type = WireType {
            name: message_type.name().to_owned(),
            md5: message_type.md5().to_owned(),
            definition: message_type.full_text().to_owned(),
        };
        let outlet = Arc::new(Outlet {
            topic: topic.to_owned(),
            message_type,
            latch,
            wire_type: Arc::new(wire_type.clone()),
            name: format!("client#{}", shared.next_number()).into(),
            shared: shared.clone(),
            last: Mutex::default(),
            connected: watch::Sender::default(),
            state: Mutex::new(State::Warming { waiting: VecDeque::new(), bytes: 0 }),
        });
        shared.add_outlet(&outlet);
        let options = AdvertiseOptions { wire_type, latch, queue };
        // Holds the outlet until what was published at once has been sent, even if the client is gone by then.
        tokio::spawn(warm_up(outlet.clone(), options, failed));
        outlet
    }

    pub(crate) fn publish(&self, bytes: Bytes) {
        self.shared.metrics.published.add(1);
        if self.latch {
            *self.last.lock() = Some(bytes.clone());
        }
        if let Some(hub) = self.shared.live_hub(&self.topic) {
            hub.deliver(self.message(bytes.clone()), true);
        }
        match &mut *self.state.lock() {
            State::Live(publisher) => publisher.publish(bytes),
            State::Failed => {}
            State::Warming { waiting, bytes: held } => {
                *held += bytes.len();
                waiting.push_back(bytes);
                while waiting.len() > WARM_MESSAGES || (*held > WARM_BYTES && waiting.len() > 1) {
                    let Some(lost) = waiting.pop_front() else { break };
                    *held -= lost.len();
                    self.shared.metrics.dropped.add(1);
                    self.shared.metrics.dropped_bytes.add(lost.len() as u64);
                }
            }
        }
    }

    /// Ready when a node has connected.
    pub(crate) async fn connected(&self) {
        let mut connected = self.connected.subscribe();
        // The sender lives as long as `self`.
        let _ = connected.wait_for(|count| *count > 0).await;
    }

    pub(crate) fn has_subscriber(&self) -> bool {
        *self.connected.borrow() > 0
    }

    /// What a newcomer is given.
    pub(crate) fn latched(&self) -> Option<Message> {
        self.last.lock().clone().map(|bytes| self.message(bytes))
    }

    fn message(&self, bytes: Bytes) -> Message {
        Message { bytes, wire_type: self.wire_type.clone(), publisher: self.name.clone(), latching: self.latch }
    }

    fn go(&self, next: State) {
        let mut state = self.state.lock();
        if let (State::Warming { waiting, .. }, State::Live(publisher)) = (&mut *state, &next) {
            for bytes in waiting.drain(..) {
                publisher.publish(bytes);
            }
        }
        *state = next;
    }
}

impl Drop for Outlet {
    fn drop(&mut self) {
        self.shared.forget_outlet(self);
    }
}

async fn warm_up(outlet: Arc<Outlet>, options: AdvertiseOptions, failed: impl FnOnce(String) + Send) {
    let shared = outlet.shared.clone();
    let deadline = Instant::now() + shared.options.warm_up;
    let publisher = match shared.bus.advertise(&outlet.topic, options).await {
        Ok(publisher) => publisher,
        Err(error) => {
            outlet.go(State::Failed);
            return failed(error.to_string());
        }
    };
    let mut subscribers = publisher.subscribers();
    // Nodes that the Master names as subscribers; the bridge itself may be among them, but never connects.
    let expected = |shared: &Shared| {
        let graph = shared.bus.graph();
        let graph = graph.borrow();
        let named = graph.topics.get(&outlet.topic).map_or(0, |nodes| nodes.subscribers.len());
        named.saturating_sub(usize::from(shared.live_hub(&outlet.topic).is_some())).max(1)
    };
    let connected = async {
        while *subscribers.borrow_and_update() < expected(&shared) {
            if subscribers.changed().await.is_err() {
                return;
            }
        }
    };
    // Out of patience: whoever is connected gets what waits.
    let _ = timeout_at(deadline.into(), connected).await;
    outlet.connected.send_replace(*subscribers.borrow());
    outlet.go(State::Live(publisher));
    follow(Arc::downgrade(&outlet), subscribers);
}

/// Tells those who wait for a first subscriber, for as long as the outlet lives.
fn follow(outlet: Weak<Outlet>, mut subscribers: watch::Receiver<usize>) {
    tokio::spawn(async move {
        loop {
            let Some(outlet) = outlet.upgrade() else { return };
            outlet.connected.send_replace(*subscribers.borrow_and_update());
            drop(outlet);
            // An error means that the publisher is gone, and the outlet with it.
            if subscribers.changed().await.is_err() {
                return;
            }
        }
    });
}
