//! Topics that the node publishes: subscribed to in the servant only while the robot has listeners, so a node that
//! works only for listeners does so here, too.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{Bus, Graph, Matched, PeerId, Qos, Subscription, WireType, reaches};
use tokio::sync::watch;
use tokio::task::AbortHandle;

use super::Hub;
use super::given::Given;
use super::held::Hold;
use super::inputs::{Mark, mark};
use super::node_link::NodeLink;
use super::retry::Retry;
use link::Quality;
use link::clock::now;
use link::drops::Cause;
use link::record::{Answered, Data};
use link::skew::Direction;
use ros::codec::Stamps;

/// Messages that the bus keeps for a busy link.
const QUEUE: usize = 256;
/// Publishers of a topic that are remembered.
const REMEMBERED: usize = 256;
/// Between two questions whether a node sends a topic to us, at first and at last.
const LOOK: std::time::Duration = std::time::Duration::from_millis(2);
const LONGEST_LOOK: std::time::Duration = std::time::Duration::from_millis(50);

/// Outputs by channel.
#[derive(Default)]
pub(super) struct Outputs {
    channels: Mutex<HashMap<u32, Channel>>,
    given: Mutex<Given>,
}

struct Channel {
    topic: String,
    stamps: Stamps,
    /// How many listen once all that the robot told is done.
    expected: usize,
    reading: Option<AbortHandle>,
}

impl Drop for Channel {
    fn drop(&mut self) {
        if let Some(reading) = self.reading.take() {
            reading.abort();
        }
    }
}

impl Outputs {
    /// The robot is told of this output.
    pub(super) fn add(&self, channel: u32, topic: &str, stamps: Stamps) {
        let fresh = Channel {
            topic: topic.to_owned(),
            stamps,
            expected: 0,
            reading: None,
        };
        self.channels.lock().insert(channel, fresh);
    }

    pub(super) fn remove(&self, channel: u32) {
        self.channels.lock().remove(&channel);
    }

    pub(super) fn clear(&self) {
        self.channels.lock().clear();
    }

    /// An input was given to the node.
    pub(super) fn note(&self, channel: u32, mark: Mark, answered: Answered) {
        // What nobody listens to is not seen, whether or not it comes.
        let heard = self.is_heard();
        self.given.lock().note(channel, mark, answered, heard);
    }

    fn is_heard(&self) -> bool {
        let channels = self.channels.lock();
        channels.values().any(|channel| channel.reading.is_some())
    }

    /// How many inputs it was given while somebody listened, and how many outputs came.
    pub(super) fn flow(&self) -> (u64, u64) {
        self.given.lock().flow()
    }

    /// Of how many of the last inputs something is known, and how many of them the node has left out.
    pub(super) fn left_out(&self) -> (usize, usize) {
        self.given.lock().left_out()
    }

    /// So many will listen, as soon as that is done; whether they are the first ones.
    pub(super) fn expect(&self, channel: u32, count: usize) -> bool {
        let mut channels = self.channels.lock();
        let Some(known) = channels.get_mut(&channel) else {
            return false;
        };
        std::mem::replace(&mut known.expected, count) == 0 && count > 0
    }

    /// So many listen on the robot now; `hold` is let go of once the node knows of it.
    pub(super) fn listeners(
        &self,
        link: &Arc<NodeLink>,
        hub: &Arc<Hub>,
        (channel, count): (u32, usize),
        hold: Option<Hold>,
    ) {
        let (topic, stamps) = {
            let mut channels = self.channels.lock();
            let Some(known) = channels.get_mut(&channel) else {
                return;
            };
            match (&known.reading, count) {
                (Some(_), 0) => {
                    if let Some(reading) = known.reading.take() {
                        reading.abort();
                    }
                    return;
                }
                (None, 1..) => (known.topic.clone(), known.stamps.clone()),
                _ => return,
            }
        };
        let (bus, warm_up) = (Arc::clone(&hub.bus), hub.options.warm_up);
        let (reader, hub) = (Arc::clone(link), Arc::downgrade(hub));
        let reading = tokio::spawn(async move {
            let before = match bus.hearing() {
                Some(hearing) => hearing.heard_over(&topic).await.unwrap_or_default(),
                None => BTreeSet::new(),
            };
            // All of it, or its guard would stay behind and end the subscription.
            let subscription = &mut { subscribe(&*bus, &topic).await };
            reader
                .drops
                .watch(&topic, Cause::Busy, Arc::clone(&subscription.dropped));
            let publishers = subscription.matched.clone();
            let connected = async {
                let heard = heard(&*bus, &reader.node, &topic, publishers, before);
                let _ = tokio::time::timeout(warm_up, heard).await;
                drop(hold);
            };
            let mut met = subscription.matched.clone();
            met.mark_changed();
            let read = async {
                let mut own = OwnPublishers::default();
                loop {
                    let message = tokio::select! {
                        biased;
                        Ok(()) = met.changed() => {
                            let Some(hub) = hub.upgrade() else { break };
                            let present = met.borrow_and_update().clone();
                            own.meet(&present, |node| hub.is_of(&reader, node));
                            continue;
                        }
                        message = subscription.messages.recv() => message,
                    };
                    let (Some(message), Some(hub)) = (message, hub.upgrade()) else {
                        break;
                    };
                    // Other nodes of the servant have links of their own.
                    if own.has(&message.publisher, |node| hub.is_of(&reader, node)) {
                        let quality = Quality::of(&message.wire_type.name, message.latching);
                        let bytes = reader.shift(&hub, Direction::Out, &stamps, message.bytes);
                        reader.send(channel, bytes, message.latching, quality);
                    }
                }
            };
            tokio::join!(connected, read);
        });
        if let Some(known) = self.channels.lock().get_mut(&channel) {
            known.reading = Some(reading.abort_handle());
        } else {
            reading.abort();
        }
    }
}

/// Subscribes to an output; tries again while that is refused.
async fn subscribe(bus: &dyn Bus, topic: &str) -> Subscription {
    // As latching as the node: of a bus with qualities of service it is a wish, and the node's own offer is what is heard.
    let qos = Qos::keep_last(QUEUE).latching(true);
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

/// Publishers of a topic that are known to be of the link's process: what one has sent before it was gone still is the process's, and the graph
/// has no node of its name any more.
#[derive(Default)]
struct OwnPublishers(BTreeSet<PeerId>);

impl OwnPublishers {
    fn has(&mut self, publisher: &PeerId, is_of: impl Fn(&str) -> bool) -> bool {
        if self.0.contains(publisher) {
            return true;
        }
        let has = is_of(publisher.node());
        if has {
            // Whoever made so many is not worth being remembered.
            if self.0.len() >= REMEMBERED {
                self.0.clear();
            }
            self.0.insert(publisher.clone());
        }
        has
    }

    /// These are there now.
    fn meet(&mut self, present: &Matched, is_of: impl Fn(&str) -> bool) {
        for peer in present.peers.iter().filter(|peer| peer.connected) {
            self.has(&peer.id, &is_of);
        }
    }
}

/// Returns once the node sends the topic to us, over a connection that is not one of those before.
async fn heard(
    bus: &dyn Bus,
    node: &str,
    topic: &str,
    publishers: watch::Receiver<Matched>,
    before: BTreeSet<PeerId>,
) {
    let Some(hearing) = bus.hearing() else {
        // Both know of each other then; nodes of other processes may publish the same topic.
        let mut publishers = publishers;
        let nodes = publishing(&bus.graph().borrow(), node, topic);
        let all = |now: &Matched| nodes.iter().all(|node| now.has_node(node));
        let _ = publishers.wait_for(all).await;
        return;
    };
    reaches(publishers, 1).await;
    let mut pause = LOOK;
    loop {
        let Ok(now) = hearing.heard_over(topic).await else {
            return;
        };
        if now.difference(&before).any(|by| by.node() == node) {
            return;
        }
        tokio::time::sleep(pause).await;
        pause = (pause * 2).min(LONGEST_LOOK);
    }
}

/// The nodes of a process that publish the topic.
fn publishing(graph: &Graph, node: &str, topic: &str) -> BTreeSet<String> {
    let mut nodes = graph.of_process(node);
    nodes.retain(|node| graph.publishes(node, topic));
    if nodes.is_empty() {
        nodes.insert(node.to_owned());
    }
    nodes
}

impl Hub {
    /// Whether a node is one of the link's process.
    fn is_of(&self, link: &NodeLink, node: &str) -> bool {
        let graph = || self.bus.graph();
        node == link.node || graph().borrow().is_of_process(&link.node, node)
    }
}

impl NodeLink {
    fn send(&self, channel: u32, message: Bytes, latching: bool, quality: Quality) {
        let born = now();
        let data = Data {
            channel,
            encoded: false,
            latching,
            born,
            left: 0,
            serialise: 0,
            answered: self.outputs.given.lock().answered_by(mark(&message), born),
            message,
        };
        self.session.publish(data, quality);
    }
}

#[cfg(test)]
mod tests {
    use ros::bus::Peer;

    use super::*;

    #[test]
    fn what_a_node_has_sent_is_its_processs_when_it_is_gone() {
        let peer = |node: &str, number: u64| PeerId::new(node, u128::from(number));
        let (mut own, gone) = (OwnPublishers::default(), |_: &str| false);
        let is_of = |node: &str| node == "/tenor";
        assert!(own.has(&peer("/tenor", 1), is_of));
        assert!(!own.has(&peer("/bass", 1), is_of));
        assert!(own.has(&peer("/tenor", 1), gone) && !own.has(&peer("/tenor", 2), gone));
        // It has sent nothing yet that was looked at.
        let there = |id: PeerId| Peer {
            id,
            connected: true,
            offer: None,
        };
        let present = Matched {
            peers: vec![there(peer("/tenor", 2)), there(peer("/bass", 2))],
            ..Matched::default()
        };
        own.meet(&present, is_of);
        assert!(own.has(&peer("/tenor", 2), gone) && !own.has(&peer("/bass", 2), gone));
        for number in 0..2 * REMEMBERED as u64 {
            own.has(&peer("/tenor", number), is_of);
        }
        assert!(own.0.len() <= REMEMBERED);
    }
}
