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
    let service = format!("{}/get_parameters", link.node);
    let answers = |graph: &Arc<Graph>| graph.services.contains_key(&service);
    let mut graphs = hub.bus.graph();
    // Once for each of its lives: one that starts again has the value that it was started with.
    while graphs.wait_for(answers).await.is_ok() {
        let followed = tokio::select! {
            followed = lives(&link, parameters) => followed,
            _ = graphs.wait_for(|graph| !answers(graph)) => continue,
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

/// One life of the node, or until the bus is closed.
async fn lives(link: &NodeLink, parameters: &dyn NodeParameters) -> Result<(), BusError> {
    let mut events = parameters.watch(Some(&link.node)).await?;
    let asked = [SIMULATED.to_owned()];
    let held = parameters.get(&link.node, &asked).await?;
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
