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

use crate::shared::Shared;

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
    /// Not yet advertised, or a node that the Master names as subscriber has not connected yet: messages wait a
    /// moment, since clients publish right behind their `advertise`, or as soon as rosapi names a subscriber.
    Warming {
        waiting: VecDeque<Bytes>,
        bytes: usize,
        publisher: Option<Box<dyn Publisher>>,
    },
    Live {
        publisher: Box<dyn Publisher>,
        /// The graph in which waiting has ended: whoever had not connected by then is not waited for again.
        settled: u64,
    },
    Failed,
}

impl State {
    fn warming(publisher: Option<Box<dyn Publisher>>) -> State {
        State::Warming {
            waiting: VecDeque::new(),
            bytes: 0,
            publisher,
        }
    }
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
            state: Mutex::new(State::warming(None)),
        });
        shared.add_outlet(&outlet);
        let options = AdvertiseOptions {
            wire_type,
            latch,
            queue,
        };
        // Holds the outlet until what was published at once has been sent, even if the client is gone by then.
        tokio::spawn(warm_up(outlet.clone(), options, failed));
        outlet
    }

    pub(crate) fn publish(self: &Arc<Self>, bytes: Bytes) {
        self.shared.metrics.published.add(1);
        if self.latch {
            *self.last.lock() = Some(bytes.clone());
        }
        if let Some(hub) = self.shared.live_hub(&self.topic) {
            hub.deliver(self.message(bytes.clone()), true);
        }
        let mut state = self.state.lock();
        if let State::Live { publisher, settled } = &*state
            && *publisher.subscribers().borrow() < self.expected(*settled)
        {
            let subscribers = publisher.subscribers();
            if let State::Live { publisher, .. } =
                std::mem::replace(&mut *state, State::warming(None))
            {
                *state = State::warming(Some(publisher));
            }
            let deadline = Instant::now() + self.shared.options.warm_up;
            tokio::spawn(settle(self.clone(), subscribers, deadline));
        }
        match &mut *state {
            State::Live { publisher, .. } => publisher.publish(bytes),
            State::Failed => {}
            State::Warming {
                waiting,
                bytes: held,
                ..
            } => {
                *held += bytes.len();
                waiting.push_back(bytes);
                while waiting.len() > WARM_MESSAGES || (*held > WARM_BYTES && waiting.len() > 1) {
                    let Some(lost) = waiting.pop_front() else {
                        break;
                    };
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
        Message {
            bytes,
            wire_type: self.wire_type.clone(),
            publisher: self.name.clone(),
            latching: self.latch,
        }
    }

    /// How many nodes should be connected, or none if the graph is still the one of generation `settled`. The
    /// bridge itself may be among those that the Master names, but never connects.
    fn expected(&self, settled: u64) -> usize {
        let graph = self.shared.bus.graph();
        let graph = graph.borrow();
        if graph.generation == settled {
            return 0;
        }
        let named = graph
            .topics
            .get(&self.topic)
            .map_or(0, |nodes| nodes.subscribers.len());
        named.saturating_sub(usize::from(self.shared.live_hub(&self.topic).is_some()))
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
        for bytes in waiting.drain(..) {
            publisher.publish(bytes);
        }
        *state = State::Live { publisher, settled };
    }
}

impl Drop for Outlet {
    fn drop(&mut self) {
        self.shared.forget_outlet(self);
    }
}

async fn warm_up(
    outlet: Arc<Outlet>,
    options: AdvertiseOptions,
    failed: impl FnOnce(String) + Send,
) {
    let shared = outlet.shared.clone();
    let deadline = Instant::now() + shared.options.warm_up;
    let publisher = match shared.bus.advertise(&outlet.topic, options).await {
        Ok(publisher) => publisher,
        Err(error) => {
            *outlet.state.lock() = State::Failed;
            return failed(error.to_string());
        }
    };
    let subscribers = publisher.subscribers();
    if let State::Warming {
        publisher: held, ..
    } = &mut *outlet.state.lock()
    {
        *held = Some(publisher);
    }
    follow(Arc::downgrade(&outlet), subscribers.clone());
    settle(outlet, subscribers, deadline).await;
}

/// Waits until all are connected who should be, at least one; those out of patience get nothing of what waits.
async fn settle(outlet: Arc<Outlet>, mut subscribers: watch::Receiver<usize>, deadline: Instant) {
    let connected = async {
        // No generation is that high: the graph as it is counts.
        while *subscribers.borrow_and_update() < outlet.expected(u64::MAX).max(1) {
            if subscribers.changed().await.is_err() {
                return;
            }
        }
    };
    let _ = timeout_at(deadline.into(), connected).await;
    outlet.connected.send_replace(*subscribers.borrow());
    outlet.go_live();
}

/// Tells those who wait for a first subscriber, for as long as the outlet lives.
fn follow(outlet: Weak<Outlet>, mut subscribers: watch::Receiver<usize>) {
    tokio::spawn(async move {
        loop {
            let Some(outlet) = outlet.upgrade() else {
                return;
            };
            outlet
                .connected
                .send_replace(*subscribers.borrow_and_update());
            drop(outlet);
            // An error means that the publisher is gone, and the outlet with it.
            if subscribers.changed().await.is_err() {
                return;
            }
        }
    });
}
