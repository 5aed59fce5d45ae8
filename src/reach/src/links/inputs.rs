//! Topics of the robot that the node listens to: published in the servant as the robot's publishers publish them.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{Graph, Liveliness, Publisher, Qos, RosVersion, WireType};
use ros::ring::{Bounds, Ring};
use ros::schema::{MessageType, SchemaError};
use ros::sizes::Sizes;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::retry::Retry;
use super::{Hub, types};
use link::clock::now;
use link::control::Input;
use link::drops::{Cause, Drops};
use link::record::{Answered, Data};
use link::skew::{Direction, Skew};
use ros::codec::Stamps;

/// Messages kept for a slow node.
const QUEUE: usize = 256;
/// Messages of a transient-local publisher of ROS 2 that newcomers are given, where the robot does not tell how many it keeps:
/// what ROS 2 itself takes where nobody says it.
const KEPT: usize = 10;
/// So many times the warm-up a node that has registered is waited for where nobody is connected.
const ALONE: u32 = 10;
/// What waits until the topic is advertised and the node connected.
const WAITING: Bounds = Bounds {
    messages: 256,
    bytes: 32 << 20,
};

/// Where types that begin with a header have their stamp. Those that do not have something there, too; it tells no
/// worse than nothing which input an output answers. In ROS 1 the header's number stands before the stamp, in ROS 2 the four bytes
/// that say how the message is written: seconds and nanoseconds stand at the same place.
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
    latching: bool,
    state: State,
    /// It could not be advertised when that was tried last.
    is_refused: bool,
    /// It is closed once what waits has reached the node.
    is_closing: bool,
}

enum State {
    /// Not advertised yet, or the node has not connected.
    Waiting(Ring<Bytes>),
    Open(Arc<dyn Publisher>),
}

impl Inputs {
    /// Messages of this channel may come before it is open.
    pub(super) fn expect(&self, hub: &Hub, input: &Input) {
        let of = definition(hub, input).inspect_err(|error| {
            tracing::debug!(topic = input.topic, %error, "its stamps stay as they are");
        });
        let of = of.ok();
        let fresh = Channel {
            topic: input.topic.clone(),
            stamps: stamps(input, of.as_deref()),
            sizes: hub.inputs.of(&input.topic, of.as_deref()),
            latching: input.latching,
            state: State::Waiting(Ring::new(WAITING)),
            is_refused: false,
            is_closing: false,
        };
        self.channels.lock().insert(input.channel, fresh);
    }

    /// Publishes a message, with its stamps changed where they have to be; says when, and by what its answer may be known.
    pub(super) fn take(
        &self,
        (skew, drops): (Option<&Skew>, &Drops),
        data: Data,
        arrived: i64,
    ) -> Option<(Mark, Answered)> {
        let mut channels = self.channels.lock();
        let channel = channels.get_mut(&data.channel)?;
        let message = data.message;
        // By the robot's stamp: outputs are looked at when theirs are the robot's again.
        let mark = mark(&message);
        channel.sizes.note(&message);
        let message = match skew {
            Some(skew) => skew.apply(Direction::In, &channel.stamps, message),
            None => message,
        };
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

    /// Advertises, and lets messages through once the node has connected. While it is refused it is tried again, at `turns` that it
    /// takes as others do; the first one is `turn`.
    pub(super) async fn open(
        &self,
        hub: &Arc<Hub>,
        drops: &Drops,
        input: Input,
        (turns, turn): (Arc<Semaphore>, OwnedSemaphorePermit),
    ) {
        let mut retry = Retry::default();
        let mut turn = Some(turn);
        let publisher: Arc<dyn Publisher> = loop {
            let of = wire_type(hub, &input);
            let qos = offer(&input, hub.bus.version(), &hub.bus.graph().borrow());
            match hub.bus.advertise(&input.topic, of, qos).await {
                Ok(publisher) => break publisher.into(),
                Err(error) => {
                    if retry.is_first() {
                        tracing::warn!(topic = input.topic, %error, "an input cannot be published; trying again");
                    }
                    if !self.refused(drops, input.channel) {
                        return;
                    }
                }
            }
            drop(turn.take());
            retry.pause().await;
            turn = Arc::clone(&turns).acquire_owned().await.ok();
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
            let own = hub.bus.node();
            let beside = nodes.filter(|node| *node != bridge::INSIDE && *node != own);
            beside.count()
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
            channel.is_refused = false;
        }
    }

    /// The channel could not be advertised: what waits for it is too old by the next time, unless it is latched. False where there is no
    /// next time.
    fn refused(&self, drops: &Drops, channel: u32) -> bool {
        let mut channels = self.channels.lock();
        let Some(channel) = channels.get_mut(&channel) else {
            return false;
        };
        channel.is_refused = true;
        if let State::Waiting(waiting) = &mut channel.state {
            if !channel.latching {
                drops.add(&channel.topic, Cause::Early, waiting.len() as u64);
                waiting.clear();
            }
        }
        !channel.is_closing
    }

    /// The robot closes this channel. Whether what waits for it will reach the node in a while, and is waited for.
    pub(super) fn closes(&self, channel: u32) -> bool {
        let mut channels = self.channels.lock();
        channels.get_mut(&channel).is_some_and(|channel| {
            channel.is_closing = true;
            !channel.is_refused
        })
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

fn wire_type(hub: &Hub, input: &Input) -> WireType {
    WireType::new(&input.type_name, &input.md5, &input.definition).written_by(hub.bus.version())
}

/// What an input's type is. Publishers of ROS 1 tell it; of ROS 2 the image knows it, if it has the same.
fn definition(hub: &Hub, input: &Input) -> Result<Arc<MessageType>, SchemaError> {
    if hub.bus.version() == RosVersion::One {
        return MessageType::from_full_text(&input.type_name, &input.definition);
    }
    let of = wire_type(hub, input);
    types::message(&hub.registry, &of).map_or_else(|| of.schema(), Ok)
}

/// What is offered to nodes in place of the robot's publisher. In ROS 2 a reliable publisher is heard by those, too, who do not
/// ask for one; of time it offers what the robot's does, else what is asked for, which the robot's must offer to be heard at all.
fn offer(input: &Input, version: RosVersion, graph: &Graph) -> Qos {
    let latching = input.latching;
    if version == RosVersion::One {
        return Qos::keep_last(QUEUE).latching(latching);
    }
    let told = input.qos.as_ref().map(|qos| qos.to_qos(1));
    let kept = told.map_or(KEPT, |told| told.depth);
    let latching = latching || told.is_some_and(|told| told.is_latching());
    let mut offer = Qos {
        lifespan: told.and_then(|told| told.lifespan),
        ..Qos::keep_last(if latching { kept } else { QUEUE }).latching(latching)
    };
    let asked = graph.ends.values();
    let asked = asked.filter_map(|node| node.subscribers.get(&input.topic));
    for of in told.into_iter().chain(asked.map(|(_, qos)| *qos)) {
        let least = |one: Option<Duration>, two| one.into_iter().chain(two).min();
        offer.deadline = least(offer.deadline, of.deadline);
        offer.lease = least(offer.lease, of.lease);
        if of.liveliness == Liveliness::ManualByTopic {
            offer.liveliness = Liveliness::ManualByTopic;
        }
    }
    offer
}

/// Where the stamps of an input stand. `/clock` tells simulated time.
fn stamps(input: &Input, of: Option<&MessageType>) -> Stamps {
    match of {
        Some(of) if input.topic != "/clock" => Stamps::of(of),
        _ => Stamps::default(),
    }
}

#[cfg(test)]
mod tests {
    use ros::bus::{NodeEnds, Reliability};

    use super::*;

    fn asks(qos: Qos) -> Graph {
        let of = WireType::named("std_msgs/msg/String").written_by(RosVersion::Two);
        let ends = NodeEnds {
            subscribers: [("/scan".to_owned(), (of, qos))].into(),
            ..NodeEnds::default()
        };
        Graph {
            ends: [("/see".to_owned(), ends)].into(),
            ..Graph::default()
        }
    }

    fn input(latching: bool, qos: Option<link::control::Qos>) -> Input {
        Input {
            topic: "/scan".to_owned(),
            latching,
            qos,
            ..Input::default()
        }
    }

    #[test]
    fn nodes_are_offered_what_they_ask_for() {
        let asked = Qos {
            reliability: Reliability::BestEffort,
            deadline: Some(Duration::from_millis(100)),
            lease: Some(Duration::from_secs(2)),
            liveliness: Liveliness::ManualByTopic,
            ..Qos::keep_last(5)
        };
        let offered = offer(&input(false, None), RosVersion::Two, &asks(asked));
        assert_eq!(
            offered,
            Qos {
                reliability: Reliability::Reliable,
                depth: QUEUE,
                ..asked
            }
        );
        // What the robot's publisher offers may be more.
        let told = link::control::Qos {
            transient_local: true,
            depth: 3,
            deadline: Some(0.05),
            ..Default::default()
        };
        let offered = offer(&input(false, Some(told)), RosVersion::Two, &asks(asked));
        assert_eq!(offered.deadline, Some(Duration::from_millis(50)));
        assert!(offered.is_latching());
        assert_eq!(offered.depth, 3);
    }

    #[test]
    fn old_maps_are_not_given_to_newcomers_for_ever() {
        let graph = Graph::default();
        let of = |latching, version| offer(&input(latching, None), version, &graph);
        assert_eq!(
            of(true, RosVersion::Two),
            Qos::keep_last(KEPT).latching(true)
        );
        assert_eq!(of(false, RosVersion::Two), Qos::keep_last(QUEUE));
        // Those of ROS 1 are given the last one, however many wait.
        assert_eq!(
            of(true, RosVersion::One),
            Qos::keep_last(QUEUE).latching(true)
        );
    }

    #[test]
    fn a_stamp_of_either_ros_is_found() {
        let stamp = [7, 0, 0, 0, 9, 0, 0, 0];
        for before in [[1, 0, 0, 0], [0, 1, 0, 0]] {
            let message = [&before[..], &stamp, b"map"].concat();
            assert_eq!(mark(&message), Some(stamp));
        }
    }
}
