//! Waiting for the subscribers of a topic that has just been advertised: what is published before they have connected
//! does not reach them.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use ros::bus::{Bus, MatchedPeers};
use tokio::sync::watch;
use tokio::time::timeout_at;

use crate::INSIDE_NODE;

/// Factor of the waiting time for a registered node while nobody else is connected: on a busy machine rospy takes
/// seconds.
const ALONE: u32 = 10;

/// Name and address of a node: another node may come with the same name.
pub type NodeAddress = (String, String);

/// Deadlines of waiting for subscribers.
#[derive(Clone, Copy)]
pub struct WaitDeadlines {
    /// Deadline for missing subscribers while others are connected.
    pub some: Instant,
    /// Deadline for registered subscribers while nobody is connected.
    pub none: Instant,
}

impl WaitDeadlines {
    /// Returns the deadlines from now on; `warm_up` is the time that connected subscribers wait for others.
    pub fn start(warm_up: Duration) -> Self {
        let now = Instant::now();
        Self { some: now + warm_up, none: now + warm_up * ALONE }
    }
}

/// Returns the nodes registered as subscribers of a topic that are not connected. `bus` itself and an observing node
/// may be registered, but never connect; nor do subscribers with incompatible quality of service.
pub fn find_missing_subscribers(bus: &dyn Bus, topic: &str, matched: &MatchedPeers) -> BTreeSet<NodeAddress> {
    let graph = bus.graph().borrow().clone();
    let Some(nodes) = graph.topics.get(topic) else {
        return BTreeSet::new();
    };
    nodes
        .subscribers
        .iter()
        .filter(|name| *name != bus.node() && *name != INSIDE_NODE)
        .filter(|name| !matched.has_node(name) && !is_refused(matched, name))
        .map(|name| {
            let address = graph.nodes.get(name).cloned();
            (name.clone(), address.unwrap_or_default())
        })
        .collect()
}

/// Returns whether an endpoint of this node does not match.
fn is_refused(matched: &MatchedPeers, node: &str) -> bool {
    let mut refused = matched.refused.iter();
    refused.any(|refusal| refusal.peer.node() == node)
}

/// Waits until all subscribers that should be connected are, and at least one is; an observing node does not count. As
/// long as nobody is connected, nobody waits for messages that a slow node would miss: it has more time. Returns those
/// that were waited for in vain; `missing` returns those that are not connected.
pub async fn wait_for_subscribers(
    subscribers: &mut watch::Receiver<MatchedPeers>,
    deadlines: WaitDeadlines,
    missing: impl Fn(&MatchedPeers) -> BTreeSet<NodeAddress>,
) -> BTreeSet<NodeAddress> {
    let mut in_time = wait_connected(subscribers, deadlines.some, &missing).await;
    let is_slow = {
        let matched = subscribers.borrow();
        matched.connected_count_except(INSIDE_NODE) == 0 && !missing(&matched).is_empty()
    };
    if !in_time && is_slow {
        in_time = wait_connected(subscribers, deadlines.none, &missing).await;
    }
    if in_time { BTreeSet::new() } else { missing(&subscribers.borrow()) }
}

/// Returns whether all subscribers that should be connected are before `until`, or the topic has ended.
async fn wait_connected(
    subscribers: &mut watch::Receiver<MatchedPeers>,
    until: Instant,
    missing: impl Fn(&MatchedPeers) -> BTreeSet<NodeAddress>,
) -> bool {
    let connected = async {
        loop {
            let matched = subscribers.borrow_and_update().clone();
            if matched.connected_count_except(INSIDE_NODE) > 0 && missing(&matched).is_empty() {
                return;
            }
            if subscribers.changed().await.is_err() {
                return;
            }
        }
    };
    timeout_at(until.into(), connected).await.is_ok()
}
