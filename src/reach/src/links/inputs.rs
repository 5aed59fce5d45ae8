//! Topics of the robot that the node listens to: published in the servant as the robot's publishers publish them.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{Publisher, Qos, WireType};
use ros::ring::{Bounds, Ring};
use ros::schema::MessageType;
use ros::sizes::Sizes;

use super::Hub;
use link::clock::now;
use link::control::Input;
use link::drops::{Cause, Drops};
use link::record::{Answered, Data};
use link::skew::{Direction, Skew};
use ros::codec::Stamps;

/// Messages kept for a slow node.
const QUEUE: usize = 256;
/// So many times the warm-up a node that has registered is waited for where nobody is connected.
const ALONE: u32 = 10;
/// What waits until the topic is advertised and the node connected.
const WAITING: Bounds = Bounds {
    messages: 256,
    bytes: 32 << 20,
};

/// Where types that begin with a header have their stamp. Those that do not have something there, too; it tells no
/// worse than nothing which input an output answers.
pub(super) type Mark = Option<[u8; 8]>;

/// The mark of a message as the node sees it.
pub(super) fn mark(message: &[u8]) -> Mark {
    let mark = message.get(4..12)?.try_into().ok()?;
    (mark != [0; 8]).then_some(mark)
}

/// Channels by number.
#[derive(Default)]
pub(super) struct Inputs {
    channels: Mutex<HashMap<u32, Channel>>,
}

struct Channel {
    topic: String,
    stamps: Stamps,
    sizes: Arc<Sizes>,
    state: State,
}

enum State {
    /// Not advertised yet, or the node has not connected.
    Waiting(Ring<Bytes>),
    Open(Arc<dyn Publisher>),
}

impl Inputs {
    /// Messages of this channel may come before it is open.
    pub(super) fn expect(&self, hub: &Hub, input: &Input) {
        let of = MessageType::from_full_text(&input.type_name, &input.definition);
        let of = of.inspect_err(|error| {
            tracing::debug!(topic = input.topic, %error, "its stamps stay as they are");
        });
        let of = of.ok();
        let fresh = Channel {
            topic: input.topic.clone(),
            stamps: stamps(input, of.as_deref()),
            sizes: hub.inputs.of(&input.topic, of.as_deref()),
            state: State::Waiting(Ring::new(WAITING)),
        };
        self.channels.lock().insert(input.channel, fresh);
    }

    /// Publishes a message; says when, and by what its answer may be known.
    pub(super) fn take(
        &self,
        (skew, drops): (&Skew, &Drops),
        data: Data,
        arrived: i64,
    ) -> Option<(Mark, Answered)> {
        let mut channels = self.channels.lock();
        let channel = channels.get_mut(&data.channel)?;
        let message = data.message;
        // By the robot's stamp: outputs are looked at when theirs are the robot's again.
        let mark = mark(&message);
        channel.sizes.note(&message);
        let message = skew.apply(Direction::In, &channel.stamps, message);
        match &mut channel.state {
            State::Open(publisher) => publisher.publish(message),
            State::Waiting(waiting) => {
                let lost = waiting.push(message);
                drops.add(&channel.topic, Cause::Early, lost.messages);
            }
        }
        let answered = Answered {
            born: data.born,
            serialise: data.serialise,
            left: data.left,
            taken: arrived,
            given: now(),
        };
        Some((mark, answered))
    }

    /// Advertises, and lets messages through once the node has connected.
    pub(super) async fn open(&self, hub: &Arc<Hub>, drops: &Drops, input: Input) {
        let of = WireType::new(&input.type_name, &input.md5, &input.definition);
        let qos = Qos::keep_last(QUEUE).latching(input.latching);
        let publisher: Arc<dyn Publisher> = match hub.bus.advertise(&input.topic, of, qos).await {
            Ok(publisher) => publisher.into(),
            Err(error) => {
                tracing::warn!(topic = input.topic, %error, "an input cannot be published");
                return;
            }
        };
        let counted = Arc::downgrade(&publisher);
        drops.ask(&input.topic, Cause::Slow, move || {
            let publisher = counted.upgrade();
            let count = publisher.as_ref().map_or(0, |it| it.dropped());
            (count, publisher.is_none())
        });
        let graph = hub.bus.graph().borrow().clone();
        // Who only observes what flows may be connected before the node is.
        let listeners = graph.topics.get(&input.topic).map_or(0, |ends| {
            let nodes = ends.subscribers.iter();
            nodes.filter(|node| *node != bridge::INSIDE).count()
        });
        let mut matched = publisher.matched();
        let mut connected = async |count: usize, patience: Duration| {
            let reached = matched.wait_for(|now| now.connected_beside(bridge::INSIDE) >= count);
            tokio::time::timeout(patience, reached).await.is_ok()
        };
        let warm_up = hub.options.warm_up;
        if !connected(listeners.max(1), warm_up).await && listeners > 0 {
            // A registered node is slow to connect on a busy machine: as long as nobody is connected, nobody else waits for it.
            connected(1, warm_up * ALONE).await;
        }
        let mut channels = self.channels.lock();
        if let Some(channel) = channels.get_mut(&input.channel) {
            if let State::Waiting(waiting) = &mut channel.state {
                for message in waiting {
                    publisher.publish(message);
                }
            }
            channel.state = State::Open(publisher);
        }
    }

    pub(super) fn undecodable(&self, drops: &Drops, channel: u32) {
        if let Some(channel) = self.channels.lock().get(&channel) {
            drops.add(&channel.topic, Cause::Undecodable, 1);
        }
    }

    pub(super) fn close(&self, channel: u32) {
        self.channels.lock().remove(&channel);
    }

    pub(super) fn clear(&self) {
        self.channels.lock().clear();
    }
}

/// Where the stamps of an input stand. `/clock` tells simulated time.
fn stamps(input: &Input, of: Option<&MessageType>) -> Stamps {
    match of {
        Some(of) if input.topic != "/clock" => Stamps::of(of),
        _ => Stamps::default(),
    }
}
