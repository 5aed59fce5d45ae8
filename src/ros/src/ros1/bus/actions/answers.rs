//! Whether what an action's servers answer reaches us. A node whose status is heard may not have begun to send its
//! results to us yet: each topic has a connection of its own, and what is published before it is there is lost.

use std::collections::HashSet;
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use tokio::time::{sleep, timeout};

use crate::ros1::bus::{Inner, heard};

/// The topics by which a server answers; its status is heard before anything is sent to it.
const PARTS: [&str; 2] = ["feedback", "result"];
/// After this long, a server that does not say that it sends to us is taken to do so: not all tell the truth.
const GIVES_UP: Duration = Duration::from_secs(3);
/// The first pause between two questions; each is twice as long as the one before.
const PAUSE: Duration = Duration::from_millis(2);
const LONGEST_PAUSE: Duration = Duration::from_millis(100);

/// A node at an address: one that was started again has another.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Answering {
    topic: String,
    node: String,
    uri: String,
}

/// Who is known to send us what it answers.
#[derive(Default)]
pub(super) struct Answers {
    known: Mutex<HashSet<Answering>>,
}

impl Answers {
    /// Returns once all that publish the action's feedback and results send these to us.
    pub(super) async fn reach_us(&self, bus: &Arc<Inner>, action: &str) {
        for part in PARTS {
            let topic = format!("{action}/{part}");
            if timeout(GIVES_UP, self.arrive(bus, &topic)).await.is_err() {
                let silent = self.unknown(bus, &topic);
                let nodes: Vec<_> = silent.iter().map(|publisher| &publisher.node).collect();
                tracing::debug!(topic, ?nodes, "they do not say that they send to us");
                self.known.lock().extend(silent);
            }
        }
    }

    async fn arrive(&self, bus: &Arc<Inner>, topic: &str) {
        let mut pause = PAUSE;
        loop {
            let unknown = self.unknown(bus, topic);
            if unknown.is_empty() {
                return;
            }
            // One that cannot be asked is gone, or about to be.
            let Ok(connections) = heard::connections(bus, topic).await else {
                return;
            };
            let sends = |by: &Answering| connections.iter().any(|peer| peer.node() == by.node);
            let (arrived, missing): (Vec<_>, Vec<_>) = unknown.into_iter().partition(sends);
            self.known.lock().extend(arrived);
            if missing.is_empty() {
                return;
            }
            sleep(pause).await;
            pause = (pause * 2).min(LONGEST_PAUSE);
        }
    }

    /// The topic's publishers that are not known yet; those that have gone are forgotten.
    fn unknown(&self, bus: &Inner, topic: &str) -> Vec<Answering> {
        let graph = bus.graph.borrow().clone();
        let mut known = self.known.lock();
        known.retain(|by| graph.nodes.get(&by.node) == Some(&by.uri));
        let publishers = graph.topics.get(topic).map(|ends| &ends.publishers);
        let others = publishers.into_iter().flatten();
        let others = others.filter(|node| **node != bus.node);
        let others = others.filter_map(|node| {
            let uri = graph.nodes.get(node)?;
            Some(Answering {
                topic: topic.to_owned(),
                node: node.clone(),
                uri: uri.clone(),
            })
        });
        others.filter(|by| !known.contains(by)).collect()
    }
}
