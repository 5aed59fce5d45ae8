//! Activation of lifecycle nodes that wait for a manager.

use std::sync::Arc;
use std::time::{Duration, Instant};

use ros_bus::{Bus, BusError, Graph};

use super::{LifecycleNode, State, Transition};

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
        for transition in [Transition::Configure, Transition::Activate] {
            let changed = self.change_state(transition, patience).await;
            changed.map_err(|error| self.begin_error(transition, &error))?;
        }
        Ok(BeginOutcome::Now)
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
