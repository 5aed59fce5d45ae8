//! Who is at the other end of a topic.

use std::fmt;
use std::sync::Arc;

use tokio::sync::watch;

use super::WireType;

/// Tells publishers, or subscribers, of a topic apart. It is shown as the name of its node.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct PeerId {
    node: Arc<str>,
    number: u128,
}

impl PeerId {
    /// One end of that node; `number` tells it from the node's others.
    pub fn new(node: impl Into<Arc<str>>, number: u128) -> Self {
        let node = node.into();
        Self { node, number }
    }

    /// The name of its node, for a look into the graph and for messages.
    pub fn node(&self) -> &str {
        &self.node
    }
}

/// The only end of that node.
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

/// What a publisher has said of all that it will send, before it sends anything.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Offer {
    /// The type of its messages.
    pub wire_type: Arc<WireType>,
    /// Whether it keeps its last message for those who come later.
    pub latching: bool,
}

/// A publisher as seen by a subscription, or the other way round.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Peer {
    /// The peer's id.
    pub id: PeerId,
    /// Whether messages can pass now; else it was connected, and has not left as far as is known.
    pub connected: bool,
    /// What it publishes, as far as is known; none of a subscriber.
    pub offer: Option<Offer>,
}

/// Who is at the other end, at one moment.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Matched {
    /// In the order in which they came.
    pub peers: Vec<Peer>,
}

impl Matched {
    /// How many are connected.
    pub fn connected(&self) -> usize {
        self.peers.iter().filter(|peer| peer.connected).count()
    }

    /// How many are connected beside the node of this name, which listens without being meant.
    pub fn connected_beside(&self, node: &str) -> usize {
        let connected = self.peers.iter().filter(|peer| peer.connected);
        connected.filter(|peer| peer.id.node() != node).count()
    }

    /// Whether this one has not left. Who has left has sent all that it had.
    pub fn contains(&self, id: &PeerId) -> bool {
        self.peers.iter().any(|peer| peer.id == *id)
    }

    /// Whether a node of this name is connected.
    pub fn has_node(&self, node: &str) -> bool {
        let mut connected = self.peers.iter().filter(|peer| peer.connected);
        connected.any(|peer| peer.id.node() == node)
    }
}

/// Returns once so many are connected; at once where the topic's own end is gone.
pub async fn reaches(mut matched: watch::Receiver<Matched>, count: usize) {
    let _ = matched
        .wait_for(|matched| matched.connected() >= count)
        .await;
}
