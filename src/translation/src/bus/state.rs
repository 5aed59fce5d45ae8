//! State that the parts of a translated bus share.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use parking_lot::Mutex;
use ros::bus::{Bus, BusError, Graph, MatchedPeers, Offer, PeerId, RosVersion, TopicPeer, WireType};

use super::losses::LossCounters;
use super::parameters::TranslatedParameters;
use super::twins::{KnownTwins, Untranslatable};
use crate::ServiceTwin;

/// State that the endpoints of a translated bus share.
pub(super) struct Translation {
    /// The servant's bus.
    pub(super) inner: Arc<dyn Bus>,
    /// ROS version of the robot.
    pub(super) version: RosVersion,
    pub(super) twins: KnownTwins,
    pub(super) losses: LossCounters,
    /// The servant's parameters as the robot sees them.
    pub(super) parameters: TranslatedParameters,
    /// Types of the services that were called, by name.
    pub(super) called: Mutex<HashMap<String, Arc<ServiceTwin>>>,
}

/// Parts of a servant that a robot does not see, by kind and name (`topic /map`).
pub type LeftOut = BTreeMap<String, LeftOutEntry>;

/// A topic, service or action that is not carried.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LeftOutEntry {
    /// Nodes that have it, by their names as the robot sees them.
    pub nodes: BTreeSet<String>,
    /// The reason, which names the field at fault.
    pub reason: String,
}

/// A graph for a robot, and what it lacks.
#[derive(Debug, Default)]
pub(super) struct TranslatedGraph {
    pub(super) graph: Graph,
    pub(super) left_out: LeftOut,
}

impl TranslatedGraph {
    pub(super) fn leave_out<'a>(
        &mut self,
        what: String,
        nodes: impl Iterator<Item = &'a str>,
        reason: &Untranslatable,
    ) {
        let entry = self.left_out.entry(what).or_default();
        entry.nodes.extend(nodes.map(str::to_owned));
        entry.reason = reason.to_string();
    }
}

impl Translation {
    /// Returns the ROS version of the servant.
    pub(super) fn servant_version(&self) -> RosVersion {
        self.inner.version()
    }

    /// Returns a node's endpoint as the robot sees it. In ROS 1 a process is one node, the one that the robot has
    /// started.
    pub(super) fn translate_peer(&self, id: &PeerId) -> PeerId {
        if self.version == RosVersion::Two {
            return id.clone();
        }
        let graph = self.inner.graph();
        let graph = graph.borrow();
        let owner = graph.process_owner(id.node());
        if owner == id.node() { id.clone() } else { id.with_node(owner) }
    }

    /// Returns the matched endpoints as the robot sees them. An offer whose type has no twin is not shown.
    pub(super) fn translate_matched(&self, matched: &MatchedPeers) -> MatchedPeers {
        let offer = |offer: &Offer| {
            let twin = self.twins.message(&offer.wire_type).ok()?;
            let wire_type = Arc::new(WireType::from_message(&twin.twin));
            Some(Offer { wire_type, latching: offer.latching, kept: offer.kept })
        };
        let peers = matched.peers.iter().map(|peer| TopicPeer {
            id: self.translate_peer(&peer.id),
            connected: peer.connected,
            offer: peer.offer.as_ref().and_then(offer),
        });
        let mut refused = matched.refused.clone();
        refused.iter_mut().for_each(|refusal| refusal.peer = self.translate_peer(&refusal.peer));
        MatchedPeers { peers: peers.collect(), refused }
    }
}

/// Returns the error for something of the bus that has no counterpart in the other ROS.
pub(super) fn not_translated(what: String, reason: impl ToString) -> BusError {
    BusError::NotTranslated { what, reason: reason.to_string() }
}
