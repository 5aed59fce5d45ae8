//! Who is at the other end of a topic.

use std::cmp::Ordering;
use std::fmt;
use std::hash::{Hash, Hasher};
use std::sync::Arc;

use tokio::sync::watch;

use super::WireType;

/// Tells publishers, or subscribers, of a topic apart. It is shown as the name of its node.
///
/// A number of more than 64 bits (a GUID of DDS) is nobody else's: of such ends it alone is compared, because the name of the
/// node may become known later than they do.
#[derive(Debug, Clone)]
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

    /// What is compared.
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

/// An end of the same topic with which no messages pass, because both ends mean different things.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal {
    /// The other end.
    pub peer: PeerId,
    /// In which they differ, with what the publisher offers and what the subscriber asks for.
    pub why: String,
}

/// Who is at the other end, at one moment.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Matched {
    /// In the order in which they came.
    pub peers: Vec<Peer>,
    /// Ends that could be there, were types and quality of service the same. ROS 1 does not know them.
    pub refused: Vec<Refusal>,
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_end_with_a_guid_stays_itself_when_its_node_becomes_known() {
        let guid = u128::from(u64::MAX) + 1;
        assert_eq!(
            PeerId::new("/talker", guid),
            PeerId::new("01.0f|1.c1", guid)
        );
        assert_ne!(
            PeerId::new("/talker", guid),
            PeerId::new("/talker", guid + 1)
        );
        assert_ne!(PeerId::new("/a", 1), PeerId::new("/b", 1));
        assert!(PeerId::new("/a", 1) < PeerId::new("/b", 0));
    }
}
