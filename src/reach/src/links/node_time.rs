//! Decides which nodes need their stamps converted: simulated time is not the time of a clock, and some robots want
//! stamps unchanged. In ROS 1 the parameter server decides for all nodes whether time is simulated; in ROS 2 each node
//! decides for itself and may change it at run time.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bytes::Bytes;
use ros::bus::{BusError, Graph, NodeParameters, ParamValue};
use ros::codec::Stamps;

use super::state::{Hub, NodeLink, NodeTime};
use link::control::Hello;
use link::skew::{Direction, Skew};

/// Parameter that enables simulated time.
pub(super) const SIM_TIME: &str = "use_sim_time";
/// Pause before a node that did not answer is asked again.
const AGAIN: Duration = Duration::from_secs(1);

impl NodeTime {
    /// Returns the time source announced in the robot's hello. In ROS 2 this is the only parameter that it contains.
    pub(super) fn from_hello(hello: &Hello) -> Self {
        let simulated = hello.parameters.get(SIM_TIME) == Some(&ParamValue::Bool(true));
        Self { kept: hello.keep_stamps, simulated: AtomicBool::new(simulated) }
    }

    fn set_simulated(&self, simulated: bool) {
        self.simulated.store(simulated, Ordering::Relaxed);
    }

    fn uses_wall_clock(&self) -> bool {
        !self.kept && !self.simulated.load(Ordering::Relaxed)
    }
}

impl NodeLink {
    /// Returns the difference of the clocks, if it applies to this node.
    pub(super) fn skew<'a>(&self, hub: &'a Hub) -> Option<&'a Skew> {
        self.time.uses_wall_clock().then_some(&hub.skew)
    }

    /// Converts the stamps of a message to the other side's time.
    pub(super) fn shift_stamps(&self, hub: &Hub, direction: Direction, stamps: &Stamps, message: Bytes) -> Bytes {
        match self.skew(hub) {
            Some(skew) => skew.apply(direction, stamps, message),
            None => message,
        }
    }
}

impl Hub {
    /// Sets simulated time for all nodes, as the parameter server does.
    pub(super) fn set_simulated(&self, simulated: bool) {
        for link in self.links.lock().values() {
            link.time.set_simulated(simulated);
        }
    }
}

/// Follows the node's own use_sim_time parameter until the link ends.
pub(super) async fn follow(link: Arc<NodeLink>, hub: Arc<Hub>) {
    let Ok(parameters) = hub.bus.node_parameters() else {
        return;
    };
    let mut graphs = hub.bus.graph();
    // Once for each run of the node: a restarted node has its initial value.
    loop {
        let answers = graphs.wait_for(|graph| node_to_ask(graph, &link.node).is_some());
        let Ok(Some(node)) = answers.await.map(|graph| node_to_ask(&graph, &link.node)) else {
            return;
        };
        let is_another = |graph: &Arc<Graph>| node_to_ask(graph, &link.node).as_ref() != Some(&node);
        let followed = tokio::select! {
            followed = follow_life(&link, &node, parameters) => followed,
            _ = graphs.wait_for(is_another) => continue,
        };
        match followed {
            Ok(()) | Err(BusError::NotOffered(_)) => return,
            Err(error) => {
                tracing::debug!(%error, "it did not say whether its time is simulated");
                tokio::time::sleep(AGAIN).await;
            }
        }
    }
}

/// Returns the node to ask: the node itself, or another one of its process if the program has no node with this name.
fn node_to_ask(graph: &Graph, node: &str) -> Option<String> {
    let answers = |node: &String| {
        let service = format!("{node}/get_parameters");
        graph.services.contains_key(&service)
    };
    let own = node.to_owned();
    if answers(&own) || graph.ends.contains_key(node) {
        return Some(own).filter(answers);
    }
    graph.process_nodes(node).into_iter().find(answers)
}

/// Follows one run of the node, or until the bus is closed.
async fn follow_life(link: &NodeLink, node: &str, parameters: &dyn NodeParameters) -> Result<(), BusError> {
    let mut events = parameters.watch(Some(node)).await?;
    let asked = [SIM_TIME.to_owned()];
    let held = parameters.get(node, &asked).await?;
    if let Some(Some(ParamValue::Bool(simulated))) = held.first() {
        link.time.set_simulated(*simulated);
    }
    while let Some(event) = events.next().await {
        for (name, value) in event.new.iter().chain(&event.changed) {
            if name == SIM_TIME {
                link.time.set_simulated(*value == ParamValue::Bool(true));
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use ros::bus::NodeEntities;

    use super::*;

    #[test]
    fn another_node_of_the_process_is_asked_where_none_is_called_so() {
        let service = |node: &str| (format!("{node}/get_parameters"), node.to_owned());
        let mark = "/cloudroid_link/front".to_owned();
        let process = |nodes: &[&str]| nodes.iter().map(ToString::to_string).collect();
        let mut graph = Graph {
            services: [service("/rear"), service("/alien")].into(),
            enclaves: [(mark, process(&["/rear"]))].into(),
            ..Graph::default()
        };
        assert_eq!(node_to_ask(&graph, "/front").as_deref(), Some("/rear"));
        assert_eq!(node_to_ask(&graph, "/bass"), None);
        // It exists and will answer.
        let ends = NodeEntities::default();
        graph.ends.insert("/front".to_owned(), ends);
        assert_eq!(node_to_ask(&graph, "/front"), None);
        graph.services.extend([service("/front")]);
        assert_eq!(node_to_ask(&graph, "/front").as_deref(), Some("/front"));
    }
}
