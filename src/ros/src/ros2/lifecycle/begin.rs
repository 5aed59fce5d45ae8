//! Has nodes begin their work that wait for somebody to tell them to.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::{LifecycleNode, State, Transition};
use crate::bus::{Bus, BusError, Graph};

/// How a node was found, or what became of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Begun {
    /// It was told to configure and to activate itself, and has.
    Now,
    /// It was in this state already: somebody else drives it, or has.
    Left(State),
    /// This node drives it.
    DrivenBy(String),
}

/// Why a node does not do its work.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "the lifecycle node {node} does not {}: {reason}; its log says why, and what it lacks is often a parameter \
     (--param) or a device",
    transition.label()
)]
pub struct NotBegun {
    /// Its absolute name.
    pub node: String,
    /// What it was asked for.
    pub transition: Transition,
    /// What it answered.
    pub reason: String,
}

impl LifecycleNode {
    /// Nodes that have a lifecycle.
    pub fn all(graph: &Graph) -> Vec<String> {
        let nodes = graph.nodes.keys();
        nodes
            .filter(|node| Self::is_one(graph, node))
            .cloned()
            .collect()
    }

    /// The node, beside those that are `ours`, that may tell this one to change its state, if there is any: a manager that a
    /// launch file has started.
    fn driver(graph: &Graph, node: &str, ours: &dyn Fn(&str) -> bool) -> Option<String> {
        let service = format!("{node}/change_state");
        let mut others = graph.ends.iter();
        let driver = others.find(|(other, ends)| {
            *other != node && !ours(other) && ends.clients.contains_key(&service)
        });
        driver.map(|(other, _)| other.clone())
    }

    /// Has it configure and activate itself, where nobody else does: not if it is in another state than unconfigured, or some
    /// node beside `ours` has a client for that. Each transition may take as long as `patience`.
    pub async fn begin(
        &self,
        ours: &(dyn Fn(&str) -> bool + Send + Sync),
        patience: Duration,
    ) -> Result<Begun, NotBegun> {
        let asked = Instant::now();
        let state = loop {
            match self.state().await {
                // It may take its time between being seen and answering.
                Err(BusError::Timeout { .. }) if asked.elapsed() < patience => {}
                told => break told,
            }
        };
        match state.map_err(|error| self.not_begun(Transition::Configure, &error))? {
            State::Unconfigured => {}
            other => return Ok(Begun::Left(other)),
        }
        let graph = Arc::clone(&self.bus.graph().borrow());
        if let Some(driver) = Self::driver(&graph, &self.node, ours) {
            return Ok(Begun::DrivenBy(driver));
        }
        for transition in [Transition::Configure, Transition::Activate] {
            let changed = self.change(transition, patience).await;
            changed.map_err(|error| self.not_begun(transition, &error))?;
        }
        Ok(Begun::Now)
    }

    fn not_begun(&self, transition: Transition, error: &BusError) -> NotBegun {
        NotBegun {
            node: self.node.clone(),
            transition,
            reason: match error {
                BusError::CallFailed { reason, .. } => reason.clone(),
                other => other.to_string(),
            },
        }
    }
}

/// Has all nodes of a system begin that have a lifecycle and that nobody drives, one after the other: how each was found.
///
/// # Errors
/// The first one that does not.
pub async fn begin_all(
    bus: &Arc<dyn Bus>,
    patience: Duration,
) -> Result<Vec<(String, Begun)>, NotBegun> {
    let graph = Arc::clone(&bus.graph().borrow());
    let mut all = Vec::new();
    for node in LifecycleNode::all(&graph) {
        let one = LifecycleNode::of(Arc::clone(bus), &node);
        let begun = one.begin(&|other| other == bus.node(), patience).await?;
        all.push((node, begun));
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::bus::{NodeEnds, ServiceType};

    #[test]
    fn a_manager_is_told_by_its_client() {
        let of = ServiceType::new("lifecycle_msgs/srv/ChangeState", "*");
        let client = |service: &str| NodeEnds {
            clients: BTreeMap::from([(service.to_owned(), of.clone())]),
            ..NodeEnds::default()
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
        let driver = |node: &str| LifecycleNode::driver(&graph, node, &ours);
        assert_eq!(driver("/drive").as_deref(), Some("/manager"));
        assert_eq!(driver("/other"), None);
        let neither = |node: &str| node != "/drive";
        assert_eq!(LifecycleNode::driver(&graph, "/drive", &neither), None);
    }

    #[test]
    fn what_does_not_begin_is_told_with_the_transition_and_what_to_do() {
        let refused = NotBegun {
            node: "/drive".to_owned(),
            transition: Transition::Activate,
            reason: "/drive did not activate, and is inactive now".to_owned(),
        };
        let words = refused.to_string();
        assert!(
            words.starts_with("the lifecycle node /drive does not activate: /drive did not"),
            "{words}"
        );
        assert!(words.contains("its log says why"), "{words}");
    }
}
