//! Topics that the node publishes, subscribed to in the servant only while the robot has subscribers, so that a node
//! that works only on demand does so here as well.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{
    Bus, Graph, MatchedPeers, PeerId, QosProfile, Retry, RosVersion, Subscription, WireType, wait_for_connected,
};
use tokio::sync::watch;
use tokio::task::AbortHandle;
use tracing::Instrument;

use super::given_inputs::{GivenInputs, Mark, stamp_mark};
use super::state::{HoldGuard, Hub, NodeLink};
use link::DeliveryMode;
use link::clock::now;
use link::control::FromCloud;
use link::drops::Cause;
use link::record::{Data, InputTiming};
use link::skew::Direction;
use ros::codec::Stamps;

/// Queue length of the bus for a busy link.
const QUEUE: usize = 256;
/// Maximum number of publishers of a topic that are remembered.
const MAX_PUBLISHERS: usize = 256;
/// Time for a publisher to say how many messages it keeps, once the first of them has arrived.
const ANNOUNCEMENT_TIMEOUT: std::time::Duration = std::time::Duration::from_millis(100);
/// First and longest interval at which it is checked whether a node sends a topic to us.
const LOOK: std::time::Duration = std::time::Duration::from_millis(2);
const LONGEST_LOOK: std::time::Duration = std::time::Duration::from_millis(50);

/// Outputs by channel.
#[derive(Default)]
pub(super) struct Outputs {
    channels: Mutex<HashMap<u32, OutputChannelState>>,
    given: Mutex<GivenInputs>,
}

struct OutputChannelState {
    topic: String,
    stamps: Stamps,
    /// Number of subscribers once all messages of the robot are processed.
    expected: usize,
    reading: Option<OutputReading>,
}

/// Subscription to an output; ends when dropped.
struct OutputReading {
    task: AbortHandle,
    latching: bool,
}

impl Drop for OutputReading {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// Subscribers of an output on the robot.
pub(super) struct ChannelListeners {
    pub(super) channel: u32,
    pub(super) count: usize,
    /// True if one of them requests what was published before it came.
    pub(super) latching: bool,
}

impl Outputs {
    /// Returns whether the node publishes this topic.
    pub(super) fn has(&self, topic: &str) -> bool {
        self.channels.lock().values().any(|channel| channel.topic == topic)
    }

    /// Adds an output that was announced to the robot.
    pub(super) fn add(&self, channel: u32, topic: &str, stamps: Stamps) {
        let fresh = OutputChannelState { topic: topic.to_owned(), stamps, expected: 0, reading: None };
        self.channels.lock().insert(channel, fresh);
    }

    pub(super) fn remove(&self, channel: u32) {
        self.channels.lock().remove(&channel);
    }

    pub(super) fn clear(&self) {
        self.channels.lock().clear();
    }

    /// Records an input given to the node.
    pub(super) fn record_input(&self, channel: u32, mark: Mark, answered: InputTiming) {
        // Outputs without subscribers are not observed.
        let heard = self.has_listeners();
        self.given.lock().record(channel, mark, answered, heard);
    }

    fn has_listeners(&self) -> bool {
        let channels = self.channels.lock();
        channels.values().any(|channel| channel.reading.is_some())
    }

    /// Returns the number of inputs while somebody subscribed, and the number of outputs.
    pub(super) fn flow(&self) -> (u64, u64) {
        self.given.lock().flow()
    }

    /// Returns the number of recent inputs whose fate is known, and how many of them the node has skipped.
    pub(super) fn skipped_inputs(&self) -> (usize, usize) {
        self.given.lock().skipped_inputs()
    }

    /// Sets the expected number of subscribers; returns whether they are the first ones.
    pub(super) fn expect_listeners(&self, channel: u32, count: usize) -> bool {
        let mut channels = self.channels.lock();
        let Some(known) = channels.get_mut(&channel) else {
            return false;
        };
        std::mem::replace(&mut known.expected, count) == 0 && count > 0
    }

    /// Sets the subscribers on the robot; `hold` is released once the node knows of them. What was published before is
    /// read only if a subscriber requests it; for a later subscriber that does, the topic is read anew.
    pub(super) fn set_listeners(
        &self,
        link: &Arc<NodeLink>,
        hub: &Arc<Hub>,
        ChannelListeners { channel, count, latching }: ChannelListeners,
        hold: Option<HoldGuard>,
    ) {
        let (topic, stamps) = {
            let mut channels = self.channels.lock();
            let Some(known) = channels.get_mut(&channel) else {
                return;
            };
            let suffices = |reading: &OutputReading| reading.latching || !latching;
            if count == 0 || known.reading.as_ref().is_some_and(suffices) {
                known.reading = known.reading.take().filter(|_| count > 0);
                return;
            }
            (known.topic.clone(), known.stamps.clone())
        };
        let (bus, warm_up) = (Arc::clone(&link.view.bus), hub.options.warm_up);
        let (reader, hub) = (Arc::clone(link), Arc::downgrade(hub));
        let reading = async move {
            let before = match bus.publisher_reports() {
                Some(hearing) => hearing.reported_connections(&topic).await.unwrap_or_default(),
                None => BTreeSet::new(),
            };
            // As a whole: if it were destructured, its guard would stay behind and end the subscription.
            let subscription = &mut { subscribe(&*bus, &topic, latching).await };
            reader.drops.watch(&topic, Cause::Busy, Arc::clone(&subscription.dropped));
            let publishers = subscription.matched.clone();
            let connected = async {
                let heard = wait_heard(&*bus, &reader.node, &topic, publishers, before);
                let _ = tokio::time::timeout(warm_up, heard).await;
                drop(hold);
            };
            let mut met = subscription.matched.clone();
            met.mark_changed();
            let read = async {
                let mut own = OwnPublishers::default();
                let mut kept = None;
                loop {
                    let message = tokio::select! {
                        biased;
                        Ok(()) = met.changed() => {
                            let Some(hub) = hub.upgrade() else { break };
                            let present = met.borrow_and_update().clone();
                            own.add_present(&present, |node| hub.is_of_link(&reader, node));
                            reader.send_kept(channel, own.kept_messages(&present), &mut kept);
                            continue;
                        }
                        message = subscription.messages.recv() => message,
                    };
                    let is_first = kept.is_none() && message.as_ref().is_some_and(|message| message.latching);
                    if latching && is_first && bus.version() == RosVersion::Two {
                        // The robot keeps as many as the node, from the first message on.
                        let _ = tokio::time::timeout(ANNOUNCEMENT_TIMEOUT, met.wait_for(say_what_they_keep)).await;
                        met.mark_changed();
                        let told = own.kept_messages(&met.borrow()).or(Some(1));
                        reader.send_kept(channel, told, &mut kept);
                    }
                    let (Some(message), Some(hub)) = (message, hub.upgrade()) else {
                        break;
                    };
                    // Other nodes of the servant have links of their own.
                    if own.is_own(&message.publisher, |node| hub.is_of_link(&reader, node)) {
                        let quality = DeliveryMode::for_type(&message.wire_type.name, message.latching);
                        let bytes = reader.shift_stamps(&hub, Direction::Out, &stamps, message.bytes);
                        reader.send_output(channel, bytes, message.latching, quality);
                    }
                }
            };
            tokio::join!(connected, read);
        };
        let reading = tokio::spawn(reading.in_current_span());
        if let Some(known) = self.channels.lock().get_mut(&channel) {
            known.reading = Some(OutputReading { task: reading.abort_handle(), latching });
        } else {
            reading.abort();
        }
    }
}

/// Subscribes to an output; retries while that is refused.
async fn subscribe(bus: &dyn Bus, topic: &str, latching: bool) -> Subscription {
    // A request that adapts to the node's offer.
    let qos = QosProfile::keep_last(QUEUE).latching(latching);
    let mut retry = Retry::default();
    loop {
        match bus.subscribe(topic, WireType::any(), qos).await {
            Ok(subscription) => return subscription,
            Err(error) => {
                if retry.is_first() {
                    tracing::warn!(topic, %error, "an output cannot be read; trying again");
                }
            }
        }
        retry.pause().await;
    }
}

/// Returns whether all transient-local publishers have said how many messages they keep, as far as their bus knows.
fn say_what_they_keep(present: &MatchedPeers) -> bool {
    let offers = present.peers.iter().filter_map(|peer| peer.offer.as_ref());
    offers.filter(|offer| offer.latching).all(|offer| offer.kept.is_some())
}

/// Publishers known to belong to the link's process. Messages of a publisher that is gone still belong to the process,
/// although the graph no longer contains its node.
#[derive(Default)]
struct OwnPublishers(BTreeSet<PeerId>);

impl OwnPublishers {
    fn is_own(&mut self, publisher: &PeerId, is_of: impl Fn(&str) -> bool) -> bool {
        if self.0.contains(publisher) {
            return true;
        }
        let has = is_of(publisher.node());
        if has {
            // So many publishers are not worth remembering.
            if self.0.len() >= MAX_PUBLISHERS {
                self.0.clear();
            }
            self.0.insert(publisher.clone());
        }
        has
    }

    /// Returns the number of messages that the known publishers give to late subscribers, together; `None` if unknown.
    fn kept_messages(&self, present: &MatchedPeers) -> Option<usize> {
        let own = present.peers.iter().filter(|peer| self.0.contains(&peer.id));
        let kept = own.filter_map(|peer| peer.offer.as_ref()?.kept);
        kept.reduce(|all, kept| all + kept)
    }

    /// Adds the publishers that are connected now.
    fn add_present(&mut self, present: &MatchedPeers, is_of: impl Fn(&str) -> bool) {
        for peer in present.peers.iter().filter(|peer| peer.connected) {
            self.is_own(&peer.id, &is_of);
        }
    }
}

/// Waits until the node sends the topic to us over a connection that did not exist before.
async fn wait_heard(
    bus: &dyn Bus,
    node: &str,
    topic: &str,
    publishers: watch::Receiver<MatchedPeers>,
    before: BTreeSet<PeerId>,
) {
    let Some(hearing) = bus.publisher_reports() else {
        // Here both ends know of each other; nodes of other processes may publish the same topic.
        let mut publishers = publishers;
        let nodes = publishing_nodes(&bus.graph().borrow(), node, topic);
        let all = |now: &MatchedPeers| nodes.iter().all(|node| now.has_node(node));
        let _ = publishers.wait_for(all).await;
        return;
    };
    wait_for_connected(publishers, 1).await;
    let mut pause = LOOK;
    loop {
        let Ok(now) = hearing.reported_connections(topic).await else {
            return;
        };
        if now.difference(&before).any(|by| by.node() == node) {
            return;
        }
        tokio::time::sleep(pause).await;
        pause = (pause * 2).min(LONGEST_LOOK);
    }
}

/// Returns the nodes of a process that publish the topic.
fn publishing_nodes(graph: &Graph, node: &str, topic: &str) -> BTreeSet<String> {
    let mut nodes = graph.process_nodes(node);
    nodes.retain(|node| graph.publishes(node, topic));
    if nodes.is_empty() {
        nodes.insert(node.to_owned());
    }
    nodes
}

impl Hub {
    /// Returns whether a node belongs to the link's process.
    fn is_of_link(&self, link: &NodeLink, node: &str) -> bool {
        let graph = || self.bus.graph();
        node == link.node || graph().borrow().is_in_process(&link.node, node)
    }
}

impl NodeLink {
    /// Tells the robot how many messages of an output late subscribers are given, if that is known and differs from
    /// `sent`.
    fn send_kept(&self, channel: u32, messages: Option<usize>, sent: &mut Option<usize>) {
        if let Some(messages) = messages.filter(|messages| *sent != Some(*messages)) {
            *sent = Some(messages);
            self.session.send_control(&FromCloud::Kept { channel, messages });
            self.session.order_after_control(channel);
        }
    }

    fn send_output(&self, channel: u32, message: Bytes, latching: bool, quality: DeliveryMode) {
        let born = now();
        let data = Data {
            channel,
            encoded: false,
            latching,
            born,
            left: 0,
            serialise: 0,
            answered: self.outputs.given.lock().match_output(stamp_mark(&message), born),
            message,
        };
        self.session.publish(data, quality);
    }
}

#[cfg(test)]
mod tests {
    use ros::bus::TopicPeer;

    use super::*;

    #[test]
    fn what_a_node_has_sent_is_its_processs_when_it_is_gone() {
        let peer = |node: &str, number: u64| PeerId::new(node, u128::from(number));
        let (mut own, gone) = (OwnPublishers::default(), |_: &str| false);
        let is_of = |node: &str| node == "/tenor";
        assert!(own.is_own(&peer("/tenor", 1), is_of));
        assert!(!own.is_own(&peer("/bass", 1), is_of));
        assert!(own.is_own(&peer("/tenor", 1), gone) && !own.is_own(&peer("/tenor", 2), gone));
        // Nothing of it was received yet.
        let there = |id: PeerId| TopicPeer { id, connected: true, offer: None };
        let present =
            MatchedPeers { peers: vec![there(peer("/tenor", 2)), there(peer("/bass", 2))], ..MatchedPeers::default() };
        own.add_present(&present, is_of);
        assert!(own.is_own(&peer("/tenor", 2), gone) && !own.is_own(&peer("/bass", 2), gone));
        for number in 0..2 * MAX_PUBLISHERS as u64 {
            own.is_own(&peer("/tenor", number), is_of);
        }
        assert!(own.0.len() <= MAX_PUBLISHERS);
    }
}
