//! Matched endpoints of a topic.

use std::cmp::Ordering;
use std::fmt;
use std::hash::{Hash, Hasher};
use std::sync::Arc;

use tokio::sync::watch;

use super::WireType;

/// Identifies a publisher or subscriber of a topic. Displayed as the name of its node.
///
/// A number of more than 64 bits (a DDS GUID) is globally unique: such ids are compared by the number alone, because
/// the name of the node may become known later than the endpoint.
#[derive(Debug, Clone)]
pub struct PeerId {
    node: Arc<str>,
    number: u128,
}

impl PeerId {
    /// Creates the id of one endpoint of a node; `number` distinguishes it from the node's other endpoints.
    pub fn new(node: impl Into<Arc<str>>, number: u128) -> Self {
        let node = node.into();
        Self { node, number }
    }

    /// Returns the name of the node, for lookups in the graph and for messages to users.
    pub fn node(&self) -> &str {
        &self.node
    }

    /// Returns the same endpoint as one of a node with another name.
    #[must_use]
    pub fn with_node(&self, node: &str) -> Self {
        Self::new(node, self.number)
    }

    /// Returns the key used for comparison.
    fn key(&self) -> (&str, u128) {
        let unique = self.number > u128::from(u64::MAX);
        (if unique { "" } else { &self.node }, self.number)
    }
}

impl PartialEq for PeerId {
    fn eq(&self, other: &Self) -> bool {
        self.key() == other.key()
    }
}

impl Eq for PeerId {}

impl Hash for PeerId {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.key().hash(state);
    }
}

impl Ord for PeerId {
    fn cmp(&self, other: &Self) -> Ordering {
        self.key().cmp(&other.key())
    }
}

impl PartialOrd for PeerId {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// The only endpoint of the named node.
impl From<&str> for PeerId {
    fn from(node: &str) -> Self {
        Self::new(node, 0)
    }
}

impl fmt::Display for PeerId {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.node)
    }
}

/// Properties that a publisher announces for all messages it will send, or that a subscriber requests.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Offer {
    /// Type of the messages.
    pub wire_type: Arc<WireType>,
    /// True if the publisher keeps its last message for late subscribers, or the subscriber requests that message.
    pub latching: bool,
    /// Number of messages that a transient-local publisher keeps for late subscribers now, up to a limit, as its
    /// heartbeats say (RTPS 2.5, section 8.3.8.6); `None` if unknown, and for subscribers. Its depth is not announced.
    pub kept: Option<usize>,
}

/// A publisher as seen by a subscription, or vice versa.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TopicPeer {
    /// Id of the peer.
    pub id: PeerId,
    /// True while messages can pass; false if the peer was connected before and, as far as is known, still exists.
    pub connected: bool,
    /// Offer of the publisher, once known, or request of the subscriber; `None` for subscribers of ROS 1, which are
    /// given what a publisher latches.
    pub offer: Option<Offer>,
}

/// An endpoint of the topic that does not match because types or QoS differ.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IncompatiblePeer {
    /// The other endpoint.
    pub peer: PeerId,
    /// The difference, with what the publisher offers and what the subscriber requests.
    pub why: String,
}

/// Snapshot of the endpoints matched with a publisher or subscription.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct MatchedPeers {
    /// Matched peers, in the order in which they appeared.
    pub peers: Vec<TopicPeer>,
    /// Endpoints that would match if types and quality of service agreed. Always empty in ROS 1.
    pub refused: Vec<IncompatiblePeer>,
}

impl MatchedPeers {
    /// Returns the number of connected peers.
    pub fn connected_count(&self) -> usize {
        self.peers.iter().filter(|peer| peer.connected).count()
    }

    /// Returns the number of connected peers that are not of the given node, for listeners that should not be counted.
    pub fn connected_count_except(&self, node: &str) -> usize {
        let connected = self.peers.iter().filter(|peer| peer.connected);
        connected.filter(|peer| peer.id.node() != node).count()
    }

    /// Returns true if the peer has not left. A peer that has left has sent everything it had to send.
    pub fn contains(&self, id: &PeerId) -> bool {
        self.peers.iter().any(|peer| peer.id == *id)
    }

    /// Returns true if a peer of this node is connected.
    pub fn has_node(&self, node: &str) -> bool {
        let mut connected = self.peers.iter().filter(|peer| peer.connected);
        connected.any(|peer| peer.id.node() == node)
    }
}

/// Waits until at least `count` peers are connected; returns at once if the local endpoint is gone.
pub async fn wait_for_connected(mut matched: watch::Receiver<MatchedPeers>, count: usize) {
    let _ = matched.wait_for(|matched| matched.connected_count() >= count).await;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_end_with_a_guid_stays_itself_when_its_node_becomes_known() {
        let guid = u128::from(u64::MAX) + 1;
        assert_eq!(PeerId::new("/talker", guid), PeerId::new("01.0f|1.c1", guid));
        assert_ne!(PeerId::new("/talker", guid), PeerId::new("/talker", guid + 1));
        assert_ne!(PeerId::new("/a", 1), PeerId::new("/b", 1));
        assert!(PeerId::new("/a", 1) < PeerId::new("/b", 0));
    }
}
