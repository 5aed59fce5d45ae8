//! Whose time a node's stamps are. Those of simulated time are no clock's, and some robots want theirs as they are. In ROS 1 the parameter
//! server says for all nodes whether time is simulated; in ROS 2 each node does for itself, and may change it while it runs.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bytes::Bytes;
use ros::bus::{BusError, Graph, NodeParameters, ParamValue};
use ros::codec::Stamps;

use super::Hub;
use super::node_link::NodeLink;
use link::control::Hello;
use link::skew::{Direction, Skew};

/// The parameter by which time is simulated.
pub(super) const SIMULATED: &str = "use_sim_time";
/// Before a node that did not answer is asked again.
const AGAIN: Duration = Duration::from_secs(1);

/// What is known of a node's time.
pub(super) struct NodeTime {
    /// The robot wants stamps as they are.
    kept: bool,
    simulated: AtomicBool,
}

impl NodeTime {
    /// As the robot says when it connects. One of ROS 2 tells its node's parameter, and no other.
    pub(super) fn of(hello: &Hello) -> Self {
        let simulated = hello.parameters.get(SIMULATED) == Some(&ParamValue::Bool(true));
        Self {
            kept: hello.keep_stamps,
            simulated: AtomicBool::new(simulated),
        }
    }

    fn simulate(&self, simulated: bool) {
        self.simulated.store(simulated, Ordering::Relaxed);
    }

    fn is_of_a_clock(&self) -> bool {
        !self.kept && !self.simulated.load(Ordering::Relaxed)
    }
}

impl NodeLink {
    /// The difference of the clocks, if it concerns this node.
    pub(super) fn skew<'a>(&self, hub: &'a Hub) -> Option<&'a Skew> {
        self.time.is_of_a_clock().then_some(&hub.skew)
    }

    /// The message with its stamps in the other side's time.
    pub(super) fn shift(
        &self,
        hub: &Hub,
        direction: Direction,
        stamps: &Stamps,
        message: Bytes,
    ) -> Bytes {
        match self.skew(hub) {
            Some(skew) => skew.apply(direction, stamps, message),
            None => message,
        }
    }
}

impl Hub {
    /// The parameter server says that the time of all nodes is simulated, or is not.
    pub(super) fn simulate(&self, simulated: bool) {
        for link in self.links.lock().values() {
            link.time.simulate(simulated);
        }
    }
}

/// Follows what the node itself says of its time, until the link ends.
pub(super) async fn follow(link: Arc<NodeLink>, hub: Arc<Hub>) {
    let Ok(parameters) = hub.bus.node_parameters() else {
        return;
    };
    let mut graphs = hub.bus.graph();
    // Once for each of its lives: one that starts again has the value that it was started with.
    loop {
        let answers = graphs.wait_for(|graph| asked(graph, &link.node).is_some());
        let Ok(Some(node)) = answers.await.map(|graph| asked(&graph, &link.node)) else {
            return;
        };
        let is_another = |graph: &Arc<Graph>| asked(graph, &link.node).as_ref() != Some(&node);
        let followed = tokio::select! {
            followed = lives(&link, &node, parameters) => followed,
            _ = graphs.wait_for(is_another) => continue,
        };
        match followed {
            Ok(()) | Err(BusError::NotOffered(_)) => return,
            Err(error) => {
                tracing::debug!(node = link.node, %error, "it did not say whether its time is simulated");
                tokio::time::sleep(AGAIN).await;
            }
        }
    }
}

/// Whom to ask: the node, or, where its program has called none so, another one of its process.
fn asked(graph: &Graph, node: &str) -> Option<String> {
    let answers = |node: &String| {
        let service = format!("{node}/get_parameters");
        graph.services.contains_key(&service)
    };
    let own = node.to_owned();
    if answers(&own) || graph.ends.contains_key(node) {
        return Some(own).filter(answers);
    }
    graph.of_process(node).into_iter().find(answers)
}

/// One life of the node, or until the bus is closed.
async fn lives(
    link: &NodeLink,
    node: &str,
    parameters: &dyn NodeParameters,
) -> Result<(), BusError> {
    let mut events = parameters.watch(Some(node)).await?;
    let asked = [SIMULATED.to_owned()];
    let held = parameters.get(node, &asked).await?;
    if let Some(Some(ParamValue::Bool(simulated))) = held.first() {
        link.time.simulate(*simulated);
    }
    while let Some(event) = events.next().await {
        for (name, value) in event.new.iter().chain(&event.changed) {
            if name == SIMULATED {
                link.time.simulate(*value == ParamValue::Bool(true));
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use ros::bus::NodeEnds;

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
        assert_eq!(asked(&graph, "/front").as_deref(), Some("/rear"));
        assert_eq!(asked(&graph, "/bass"), None);
        // It is there, and will answer.
        let ends = NodeEnds::default();
        graph.ends.insert("/front".to_owned(), ends);
        assert_eq!(asked(&graph, "/front"), None);
        graph.services.extend([service("/front")]);
        assert_eq!(asked(&graph, "/front").as_deref(), Some("/front"));
    }
}
