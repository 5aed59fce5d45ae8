//! Activation of lifecycle nodes that wait for a manager.
//!
//! ```text
//!  configure ─▶ activate ─▶ done
//!                  │ refused, or not answered soon
//!                  └─▶ subscribe to the outputs that nobody subscribes to ─▶ answered, or activate again ─▶ done
//! ```
//!
//! Some nodes become active only while somebody subscribes to what they publish. A servant's robot cannot subscribe
//! before its nodes are active, so this end does so until they are.

use std::sync::Arc;
use std::time::{Duration, Instant};

use futures_util::future::join_all;
use ros_bus::{Bus, BusError, Graph, QosProfile, Subscription, WireType, wait_for_connected};
use tokio::time::{sleep, timeout};

use super::{LifecycleNode, PATIENCE, State, Transition};
use crate::names;

/// Time after which a node that has not answered may be waiting for subscribers.
const SOON: Duration = Duration::from_secs(1);
/// Pauses before each further request to a node that refused although its outputs had subscribers: it may not know of
/// them yet.
const AGAIN: [Duration; 2] = [Duration::ZERO, Duration::from_secs(1)];

/// Outcome of activating a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum BeginOutcome {
    /// The node was configured and activated.
    Now,
    /// The node was in this state already: another node manages it, or did.
    Left(State),
    /// This node manages it.
    DrivenBy(String),
}

/// Error activating a node.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "the lifecycle node {node} does not {}: {reason}; see its log: often a parameter (--param) or a device is missing",
    transition.label()
)]
pub struct BeginError {
    /// Absolute name of the node.
    pub node: String,
    /// Transition requested.
    pub transition: Transition,
    /// The node's answer.
    pub reason: String,
}

impl LifecycleNode {
    /// Returns the nodes that have a lifecycle.
    pub fn all(graph: &Graph) -> Vec<String> {
        let nodes = graph.nodes.keys();
        nodes.filter(|node| Self::has_lifecycle(graph, node)).cloned().collect()
    }

    /// Returns a node other than those of `ours` that may change the state of this one, if there is any: a lifecycle
    /// manager started by a launch file.
    fn find_driver(graph: &Graph, node: &str, ours: &dyn Fn(&str) -> bool) -> Option<String> {
        let service = format!("{node}/change_state");
        let mut others = graph.ends.iter();
        let driver = others.find(|(other, ends)| *other != node && !ours(other) && ends.clients.contains_key(&service));
        driver.map(|(other, _)| other.clone())
    }

    /// Configures and activates the node unless another node manages it: not if it is in another state than
    /// unconfigured, or a node other than those of `ours` has a client for its transitions. Each transition may take up
    /// to `patience`.
    pub async fn begin(
        &self,
        ours: &(dyn Fn(&str) -> bool + Send + Sync),
        patience: Duration,
    ) -> Result<BeginOutcome, BeginError> {
        let asked = Instant::now();
        let state = loop {
            match self.state().await {
                // It may take some time between discovery and its first answer.
                Err(BusError::Timeout { .. }) if asked.elapsed() < patience => {}
                told => break told,
            }
        };
        match state.map_err(|error| self.begin_error(Transition::Configure, &error))? {
            State::Unconfigured => {}
            other => return Ok(BeginOutcome::Left(other)),
        }
        let graph = Arc::clone(&self.bus.graph().borrow());
        if let Some(driver) = Self::find_driver(&graph, &self.node, ours) {
            return Ok(BeginOutcome::DrivenBy(driver));
        }
        let configured = self.change_state(Transition::Configure, patience).await;
        configured.map_err(|error| self.begin_error(Transition::Configure, &error))?;
        let activated = self.activate(patience).await;
        activated.map_err(|error| self.begin_error(Transition::Activate, &error))?;
        Ok(BeginOutcome::Now)
    }

    /// Activates a configured node. If it refuses, or does not answer soon, its outputs get a subscriber until it is
    /// active.
    async fn activate(&self, patience: Duration) -> Result<(), BusError> {
        let mut activating = std::pin::pin!(self.change_state(Transition::Activate, patience));
        let mut activated = match timeout(SOON, activating.as_mut()).await {
            Ok(Ok(())) => return Ok(()),
            Ok(Err(refused)) => Err(refused),
            Err(_) => {
                let _listening = self.listen_to_outputs().await;
                return activating.await;
            }
        };
        let mut listening = self.listen_to_outputs().await;
        if listening.is_empty() {
            return activated;
        }
        for pause in AGAIN {
            sleep(pause).await;
            // A node that fails differently is not inactive any more, and may not be activated.
            if self.state().await? != State::Inactive {
                return activated;
            }
            activated = self.change_state(Transition::Activate, patience).await;
            if activated.is_ok() {
                break;
            }
            listening.extend(self.listen_to_outputs().await);
        }
        activated
    }

    /// Subscribes to the outputs of the node that nobody subscribes to, and waits until it knows.
    async fn listen_to_outputs(&self) -> Vec<Subscription> {
        let mut graph = self.bus.graph();
        // What it advertised while it was configured may not be discovered yet.
        let _ = timeout(SOON, graph.wait_for(|graph| !self.unheard_outputs(graph).is_empty())).await;
        let topics = self.unheard_outputs(&graph.borrow());
        let listening = topics.iter().map(|topic| async move {
            let any = WireType::any().with_version(self.bus.version());
            let subscribed = self.bus.subscribe(topic, any, QosProfile::keep_last(1)).await;
            let subscription = subscribed.inspect_err(|error| {
                tracing::debug!(topic, %error, "a lifecycle node may be waiting for a subscriber that it cannot get");
            });
            let subscription = subscription.ok()?;
            let _ = timeout(PATIENCE, wait_for_connected(subscription.matched.clone(), 1)).await;
            Some(subscription)
        });
        join_all(listening).await.into_iter().flatten().collect()
    }

    /// Returns the topics that the node publishes and nobody subscribes to, without those that every node has.
    fn unheard_outputs(&self, graph: &Graph) -> Vec<String> {
        let of_all_nodes =
            ["/rosout".to_owned(), "/parameter_events".to_owned(), format!("{}/transition_event", self.node)];
        let published = graph.ends.get(&self.node).into_iter().flat_map(|ends| ends.publishers.keys());
        let is_unheard = |topic: &&String| graph.topics.get(*topic).is_none_or(|ends| ends.subscribers.is_empty());
        let own = published.filter(|topic| !of_all_nodes.contains(topic) && !names::is_hidden(topic));
        own.filter(is_unheard).cloned().collect()
    }

    fn begin_error(&self, transition: Transition, error: &BusError) -> BeginError {
        BeginError {
            node: self.node.clone(),
            transition,
            reason: match error {
                BusError::CallFailed { reason, .. } => reason.clone(),
                other => other.to_string(),
            },
        }
    }
}

/// Activates all lifecycle nodes of a system that no other node manages, one after the other; returns the outcome for
/// each.
///
/// # Errors
/// The error of the first node that fails.
pub async fn begin_all(bus: &Arc<dyn Bus>, patience: Duration) -> Result<Vec<(String, BeginOutcome)>, BeginError> {
    let graph = Arc::clone(&bus.graph().borrow());
    let mut all = Vec::new();
    for node in LifecycleNode::all(&graph) {
        let one = LifecycleNode::new(Arc::clone(bus), &node);
        let begun = one.begin(&|other| other == bus.node(), patience).await?;
        all.push((node, begun));
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use ros_bus::{NodeEntities, ServiceType};

    use super::*;

    #[test]
    fn a_manager_is_told_by_its_client() {
        let of = ServiceType::new("lifecycle_msgs/srv/ChangeState", "*");
        let client = |service: &str| NodeEntities {
            clients: BTreeMap::from([(service.to_owned(), of.clone())]),
            ..NodeEntities::default()
        };
        let graph = Graph {
            ends: BTreeMap::from([
                ("/drive".to_owned(), client("/drive/change_state")),
                ("/looker".to_owned(), client("/drive/change_state")),
                ("/manager".to_owned(), client("/drive/change_state")),
            ]),
            ..Graph::default()
        };
        let ours = |node: &str| node == "/looker";
        let driver = |node: &str| LifecycleNode::find_driver(&graph, node, &ours);
        assert_eq!(driver("/drive").as_deref(), Some("/manager"));
        assert_eq!(driver("/other"), None);
        let neither = |node: &str| node != "/drive";
        assert_eq!(LifecycleNode::find_driver(&graph, "/drive", &neither), None);
    }

    #[test]
    fn what_does_not_begin_is_told_with_the_transition_and_what_to_do() {
        let refused = BeginError {
            node: "/drive".to_owned(),
            transition: Transition::Activate,
            reason: "/drive did not activate, and is inactive now".to_owned(),
        };
        let words = refused.to_string();
        assert!(words.starts_with("the lifecycle node /drive does not activate: /drive did not"), "{words}");
        assert!(words.contains("see its log"), "{words}");
    }
}
