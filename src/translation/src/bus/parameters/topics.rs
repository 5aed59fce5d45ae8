//! Topics about parameters that nodes have in the robot's ROS alone. No node of the servant publishes them; their
//! messages are made here, for as long as somebody subscribes.

use std::sync::Arc;

use bytes::Bytes;
use ros::bus::{
    BusError, MatchedPeers, MessageSender, Offer, PeerId, SerializedMessage, Subscription, TopicPeer, WireType,
    message_queue,
};
use tokio::sync::watch;
use tokio_util::task::AbortOnDropHandle;
use tracing::Instrument;

use super::event_topic;
use super::reconfigurable::ReconfigurePart;

/// Such a topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::bus) enum ParameterTopic {
    /// The changes of all nodes, for robots of ROS 2.
    Events,
    /// A topic of dynamic_reconfigure about one node, for robots of ROS 1.
    Reconfigure {
        /// The node of the servant.
        node: String,
        /// Name of that node as the robot sees it.
        owner: String,
        /// Topic of the node.
        part: ReconfigurePart,
    },
}

impl ParameterTopic {
    /// Returns the type of the messages, and whether late subscribers are given the last one.
    pub(in crate::bus) fn offer(&self) -> Result<Offer, BusError> {
        let (of, latching) = match self {
            Self::Events => (event_topic::message_type()?, false),
            Self::Reconfigure { part, .. } => (part.message_type()?, true),
        };
        Ok(Offer { wire_type: Arc::new(WireType::from_message(&of)), latching, kept: None })
    }
}

/// One subscription, which is given messages as if nodes published them.
pub(super) struct TopicFeed {
    messages: MessageSender,
    publishers: watch::Sender<MatchedPeers>,
    offer: Offer,
}

impl TopicFeed {
    /// Opens a subscription to a topic that `feed` gives messages to until it is dropped.
    pub(super) fn open<F>(
        (topic, offer): (&str, Offer),
        of: &WireType,
        depth: usize,
        feed: impl FnOnce(TopicFeed) -> F,
    ) -> Result<Subscription, BusError>
    where
        F: Future<Output = ()> + Send + 'static,
    {
        if !offer.wire_type.digest.is_compatible_with(&of.digest) {
            let (theirs, ours) = (offer.wire_type.to_string(), of.to_string());
            return Err(BusError::TypeMismatch { what: format!("topic {topic}"), theirs, ours });
        }
        let (sender, messages) = message_queue(depth);
        let (publishers, matched) = watch::channel(MatchedPeers::default());
        let feeding = tokio::spawn(feed(Self { messages: sender, publishers, offer }).in_current_span());
        let guard = Box::new(AbortOnDropHandle::new(feeding));
        Ok(Subscription { dropped: messages.drop_counter(), messages, matched, guard })
    }

    /// Sets the nodes that seem to publish the topic.
    pub(super) fn set_publishers<'n>(&self, nodes: impl Iterator<Item = &'n str>) {
        let peers = nodes.map(|node| TopicPeer { id: PeerId::from(node), connected: true, offer: None });
        let now = MatchedPeers { peers: peers.collect(), refused: Vec::new() };
        self.publishers.send_if_modified(|before| std::mem::replace(before, now.clone()) != now);
    }

    /// Gives the subscriber a message of a node.
    pub(super) fn send(&self, node: &str, bytes: Bytes) {
        self.messages.send(SerializedMessage {
            bytes,
            wire_type: Arc::clone(&self.offer.wire_type),
            publisher: PeerId::from(node),
            latching: self.offer.latching,
        });
    }
}
