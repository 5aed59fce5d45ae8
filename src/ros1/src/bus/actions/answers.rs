//! Checks that an action's servers send their responses to us. A node whose status messages arrive may not send its
//! results to us yet: each topic has a connection of its own, and anything published before that is established is
//! lost.

use std::collections::HashSet;
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use tokio::time::{sleep, timeout};

use crate::bus::{Ros1BusState, bus_info};

/// The topics on which a server responds; its status is received before anything is sent to it.
const PARTS: [&str; 2] = ["feedback", "result"];
/// Time after which a server is assumed to send to us although it does not report so: not all nodes report correctly.
const CONNECTION_TIMEOUT: Duration = Duration::from_secs(3);
/// First pause between two queries; each is twice as long as the one before.
const PAUSE: Duration = Duration::from_millis(2);
const LONGEST_PAUSE: Duration = Duration::from_millis(100);

/// A node at an address; a restarted node has another address.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct ActionPublisher {
    topic: String,
    node: String,
    uri: String,
}

/// The servers known to send their responses to us.
#[derive(Default)]
pub(super) struct KnownResponders {
    known: Mutex<HashSet<ActionPublisher>>,
}

impl KnownResponders {
    /// Waits until all nodes that publish the action's feedback and results send them to us.
    pub(super) async fn wait_until_connected(&self, bus: &Arc<Ros1BusState>, action: &str) {
        for part in PARTS {
            let topic = format!("{action}/{part}");
            if timeout(CONNECTION_TIMEOUT, self.wait_for_publishers(bus, &topic)).await.is_err() {
                let silent = self.unknown_publishers(bus, &topic);
                let nodes: Vec<_> = silent.iter().map(|publisher| &publisher.node).collect();
                tracing::debug!(topic, ?nodes, "they do not say that they send to us");
                self.known.lock().extend(silent);
            }
        }
    }

    async fn wait_for_publishers(&self, bus: &Arc<Ros1BusState>, topic: &str) {
        let mut pause = PAUSE;
        loop {
            let unknown = self.unknown_publishers(bus, topic);
            if unknown.is_empty() {
                return;
            }
            // A node that cannot be queried is gone, or about to be.
            let Ok(connections) = bus_info::connections(bus, topic).await else {
                return;
            };
            let sends = |by: &ActionPublisher| connections.iter().any(|peer| peer.node() == by.node);
            let (arrived, missing): (Vec<_>, Vec<_>) = unknown.into_iter().partition(sends);
            self.known.lock().extend(arrived);
            if missing.is_empty() {
                return;
            }
            sleep(pause).await;
            pause = (pause * 2).min(LONGEST_PAUSE);
        }
    }

    /// Returns the topic's publishers that are not known yet; forgets those that are gone.
    fn unknown_publishers(&self, bus: &Ros1BusState, topic: &str) -> Vec<ActionPublisher> {
        let graph = bus.graph.borrow().clone();
        let mut known = self.known.lock();
        known.retain(|by| graph.nodes.get(&by.node) == Some(&by.uri));
        let publishers = graph.topics.get(topic).map(|ends| &ends.publishers);
        let others = publishers.into_iter().flatten();
        let others = others.filter(|node| **node != bus.node);
        let others = others.filter_map(|node| {
            let uri = graph.nodes.get(node)?;
            Some(ActionPublisher { topic: topic.to_owned(), node: node.clone(), uri: uri.clone() })
        });
        others.filter(|by| !known.contains(by)).collect()
    }
}
