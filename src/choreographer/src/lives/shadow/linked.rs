//! Starts the nodes of a robot's stubs in a candidate, with the robot's names and parameters.

use std::time::Duration;

use reach::Reach;
use ros::bus::Graph;

use crate::Error;
use crate::lives::handle::Handle;

/// Timeout for the nodes to register what those of the robot's servant have.
const PATIENCE: Duration = Duration::from_secs(10);

/// Starts in `candidate` what the robot's stubs have started in its servant.
pub(super) async fn start(present: &Handle, candidate: &dyn Reach) -> Result<(), Error> {
    let Some(there) = present.reach() else {
        return Ok(());
    };
    let setup = there.stub_setup().await?;
    if setup.nodes.is_empty() {
        return Err(Error::Shadow(format!(
            "the stubs of robot {} have started no node since this daemon started; restart them, or compare with \
                another robot",
            present.robot
        )));
    }
    candidate.apply_stub_setup(&setup).await?;
    let wanted = there.graph().borrow().clone();
    let names: Vec<&str> = setup.nodes.iter().map(|node| node.name.as_str()).collect();
    let mut graph = candidate.graph();
    let there = graph.wait_for(|graph| has_endpoints(graph, &wanted, &names));
    // What is missing by then may come later, or is reported as missing.
    let _ = tokio::time::timeout(PATIENCE, there).await;
    Ok(())
}

/// Returns true if the graph has everything that these nodes have in the other.
fn has_endpoints(graph: &Graph, wanted: &Graph, nodes: &[&str]) -> bool {
    let of_them = |node: &String| nodes.contains(&node.as_str());
    let services = wanted.services.iter().filter(|(_, node)| of_them(node));
    let topics = wanted.topics.iter();
    services.into_iter().all(|(service, _)| graph.services.contains_key(service))
        && topics
            .filter(|(_, ends)| ends.publishers.iter().chain(&ends.subscribers).any(of_them))
            .all(|(topic, _)| graph.topics.contains_key(topic))
}
