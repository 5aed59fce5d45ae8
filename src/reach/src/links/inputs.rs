//! Topics of the robot to which the node subscribes, published in the servant with the QoS of the robot's publishers.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use bridge::{WaitDeadlines, find_missing_subscribers, wait_for_subscribers};
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{Graph, MatchedPeers, Publisher, QosLiveliness, QosProfile, Retry, RosVersion, WireType};
use ros::ring::{Ring, RingBounds};
use ros::schema::{MessageType, SchemaError};
use ros::sizes::SizeCounters;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::given_inputs::{Mark, stamp_mark};
use super::state::{Hub, NodeLink, ServantView};
use link::clock::now;
use link::control::InputChannel;
use link::drops::{Cause, DropCounters};
use link::record::{Data, InputTiming};
use link::skew::{Direction, Skew};
use ros::codec::Stamps;

/// Queue length for a slow node.
const QUEUE: usize = 256;
/// History depth for a transient-local publisher of ROS 2 if the robot does not announce one; the default of ROS 2.
const DEFAULT_DEPTH: usize = 10;
/// Limit on what waits until the topic is advertised and the node connected.
const WAITING: RingBounds = RingBounds { messages: 256, bytes: 32 << 20 };

/// Channels by number.
#[derive(Default)]
pub(super) struct InputChannels {
    channels: Mutex<HashMap<u32, InputChannelState>>,
}

struct InputChannelState {
    topic: String,
    stamps: Stamps,
    sizes: Arc<SizeCounters>,
    latching: bool,
    state: State,
    /// The last attempt to advertise it failed.
    is_refused: bool,
    /// It is closed once its queue has reached the node.
    is_closing: bool,
}

enum State {
    /// The topic is not yet advertised, or the node has not connected.
    Waiting(Ring<Bytes>),
    Open(Arc<dyn Publisher>),
}

impl InputChannels {
    /// Registers a channel, because its messages may arrive before it is open.
    pub(super) fn register(&self, hub: &Hub, view: &ServantView, input: &InputChannel) {
        let of = find_definition(view, input).inspect_err(|error| {
            tracing::debug!(topic = input.topic, %error, "its stamps stay as they are");
        });
        let of = of.ok();
        let fresh = InputChannelState {
            topic: input.topic.clone(),
            stamps: find_stamps(input, of.as_deref()),
            sizes: hub.inputs.for_input(&input.topic, of.as_deref()),
            latching: input.latching,
            state: State::Waiting(Ring::new(WAITING)),
            is_refused: false,
            is_closing: false,
        };
        self.channels.lock().insert(input.channel, fresh);
    }

    /// Publishes a message, after converting its stamps if necessary. Returns the mark by which its answer is
    /// recognized, and its timing.
    pub(super) fn publish(
        &self,
        (skew, drops): (Option<&Skew>, &DropCounters),
        data: Data,
        arrived: i64,
    ) -> Option<(Mark, InputTiming)> {
        let mut channels = self.channels.lock();
        let channel = channels.get_mut(&data.channel)?;
        let message = data.message;
        // With the robot's stamp: outputs are compared after their stamps were converted back.
        let mark = stamp_mark(&message);
        channel.sizes.record(&message);
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
        let answered =
            InputTiming { born: data.born, serialise: data.serialise, left: data.left, taken: arrived, given: now() };
        Some((mark, answered))
    }

    /// Advertises the topic and passes messages on once the node has connected. If that is refused, it is retried, each
    /// time after acquiring one of the `turns`; `turn` is the first one.
    pub(super) async fn open(
        &self,
        hub: &Arc<Hub>,
        link: &NodeLink,
        input: InputChannel,
        (turns, turn): (Arc<Semaphore>, OwnedSemaphorePermit),
    ) {
        let (bus, drops) = (&*link.view.bus, &link.drops);
        let mut retry = Retry::default();
        let mut turn = Some(turn);
        let publisher: Arc<dyn Publisher> = loop {
            let of = wire_type(&link.view, &input);
            // For the servant's nodes, whatever the robot's ROS.
            let qos = offered_qos(&input, hub.bus.version(), &hub.bus.graph().borrow());
            match bus.advertise(&input.topic, of, qos).await {
                Ok(publisher) => break publisher.into(),
                Err(error) => {
                    if retry.is_first() {
                        tracing::warn!(topic = input.topic, %error, "an input cannot be published; trying again");
                    }
                    if !self.mark_refused(drops, input.channel) {
                        return;
                    }
                }
            }
            drop(turn.take());
            retry.pause().await;
            turn = Arc::clone(&turns).acquire_owned().await.ok();
        };
        let counted = Arc::downgrade(&publisher);
        drops.watch_with(&input.topic, Cause::Slow, move || {
            let publisher = counted.upgrade();
            let count = publisher.as_ref().map_or(0, |it| it.dropped_count());
            (count, publisher.is_none())
        });
        let missing = |matched: &MatchedPeers| find_missing_subscribers(bus, &input.topic, matched);
        let deadlines = WaitDeadlines::start(hub.options.warm_up);
        wait_for_subscribers(&mut publisher.matched_subscribers(), deadlines, missing).await;
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

    /// Marks the channel as refused: what is queued will be too old at the next attempt, unless it is latched. Returns
    /// `false` if there will be no further attempt.
    fn mark_refused(&self, drops: &DropCounters, channel: u32) -> bool {
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

    /// Begins to close the channel. Returns whether its queue will reach the node soon and should be awaited.
    pub(super) fn begin_close(&self, channel: u32) -> bool {
        let mut channels = self.channels.lock();
        channels.get_mut(&channel).is_some_and(|channel| {
            channel.is_closing = true;
            !channel.is_refused
        })
    }

    pub(super) fn count_undecodable(&self, drops: &DropCounters, channel: u32) {
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

fn wire_type(view: &ServantView, input: &InputChannel) -> WireType {
    WireType::new(&input.type_name, &input.md5, &input.definition).with_version(view.bus.version())
}

/// Returns the definition of an input's type. Publishers of ROS 1 announce it; for ROS 2 it is in the image, if that
/// has the same type.
fn find_definition(view: &ServantView, input: &InputChannel) -> Result<Arc<MessageType>, SchemaError> {
    if view.bus.version() == RosVersion::One {
        return MessageType::from_full_text(&input.type_name, &input.definition);
    }
    let of = wire_type(view, input);
    view.types.find_message(&of).map_or_else(|| of.schema(), Ok)
}

/// Returns the QoS offered in place of the robot's publisher. In ROS 2 a reliable publisher also satisfies best-effort
/// subscribers. Time limits are those of the robot's publisher, or those requested, which the robot's publisher must
/// offer to be matched at all.
fn offered_qos(input: &InputChannel, version: RosVersion, graph: &Graph) -> QosProfile {
    let latching = input.latching;
    if version == RosVersion::One {
        return QosProfile::keep_last(QUEUE).latching(latching);
    }
    let told = input.qos.as_ref().map(|qos| qos.to_bus(1));
    let kept = told.map_or(DEFAULT_DEPTH, |told| told.depth);
    let latching = latching || told.is_some_and(|told| told.is_latching());
    let mut offer = QosProfile {
        lifespan: told.and_then(|told| told.lifespan),
        ..QosProfile::keep_last(if latching { kept } else { QUEUE }).latching(latching)
    };
    let asked = graph.ends.values();
    let asked = asked.filter_map(|node| node.subscribers.get(&input.topic));
    for of in told.into_iter().chain(asked.map(|(_, qos)| *qos)) {
        let least = |one: Option<Duration>, two| one.into_iter().chain(two).min();
        offer.deadline = least(offer.deadline, of.deadline);
        offer.lease = least(offer.lease, of.lease);
        if of.liveliness == QosLiveliness::ManualByTopic {
            offer.liveliness = QosLiveliness::ManualByTopic;
        }
    }
    offer
}

/// Returns the positions of the stamps of an input. `/clock` is simulated time.
fn find_stamps(input: &InputChannel, of: Option<&MessageType>) -> Stamps {
    match of {
        Some(of) if input.topic != "/clock" => Stamps::for_type(of),
        _ => Stamps::default(),
    }
}

#[cfg(test)]
mod tests {
    use ros::bus::{NodeEntities, QosReliability};

    use super::*;

    fn graph_asking(qos: QosProfile) -> Graph {
        let of = WireType::with_name("std_msgs/msg/String").with_version(RosVersion::Two);
        let ends = NodeEntities { subscribers: [("/scan".to_owned(), (of, qos))].into(), ..NodeEntities::default() };
        Graph { ends: [("/see".to_owned(), ends)].into(), ..Graph::default() }
    }

    fn input(latching: bool, qos: Option<link::control::WireQos>) -> InputChannel {
        InputChannel { topic: "/scan".to_owned(), latching, qos, ..InputChannel::default() }
    }

    #[test]
    fn nodes_are_offered_what_they_ask_for() {
        let asked = QosProfile {
            reliability: QosReliability::BestEffort,
            deadline: Some(Duration::from_millis(100)),
            lease: Some(Duration::from_secs(2)),
            liveliness: QosLiveliness::ManualByTopic,
            ..QosProfile::keep_last(5)
        };
        let offered = offered_qos(&input(false, None), RosVersion::Two, &graph_asking(asked));
        assert_eq!(offered, QosProfile { reliability: QosReliability::Reliable, depth: QUEUE, ..asked });
        // The robot's publisher may offer more.
        let told =
            link::control::WireQos { transient_local: true, depth: 3, deadline: Some(0.05), ..Default::default() };
        let offered = offered_qos(&input(false, Some(told)), RosVersion::Two, &graph_asking(asked));
        assert_eq!(offered.deadline, Some(Duration::from_millis(50)));
        assert!(offered.is_latching());
        assert_eq!(offered.depth, 3);
    }

    #[test]
    fn old_maps_are_not_given_to_newcomers_for_ever() {
        let graph = Graph::default();
        let of = |latching, version| offered_qos(&input(latching, None), version, &graph);
        assert_eq!(of(true, RosVersion::Two), QosProfile::keep_last(DEFAULT_DEPTH).latching(true));
        assert_eq!(of(false, RosVersion::Two), QosProfile::keep_last(QUEUE));
        // Subscribers of ROS 1 receive the last one, regardless of the queue length.
        assert_eq!(of(true, RosVersion::One), QosProfile::keep_last(QUEUE).latching(true));
    }

    #[test]
    fn a_stamp_of_either_ros_is_found() {
        let stamp = [7, 0, 0, 0, 9, 0, 0, 0];
        for before in [[1, 0, 0, 0], [0, 1, 0, 0]] {
            let message = [&before[..], &stamp, b"map"].concat();
            assert_eq!(stamp_mark(&message), Some(stamp));
        }
    }
}
