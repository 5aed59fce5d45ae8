//! Starts the nodes of a robot's stubs in a candidate, with the robot's names and parameters.

use std::collections::BTreeSet;
use std::time::Duration;

use reach::Reach;
use ros::bus::Graph;

use ros::ros1::own_parameters::is_set_by_master;

use crate::Error;
use crate::lives::handle::Handle;

/// Parameter namespace in which links keep the runs of nodes.
const RUNS: &str = "/cloudroid_runs/";
/// Timeout for the nodes to register what those of the robot's servant have.
const PATIENCE: Duration = Duration::from_secs(10);

/// Starts in `candidate` what the robot's stubs have started in its servant.
pub(super) async fn start(present: &Handle, candidate: &dyn Reach) -> Result<(), Error> {
    let Some(there) = present.reach() else {
        return Ok(());
    };
    let linked = there.stub_nodes().await;
    if linked.is_empty() {
        return Err(Error::Shadow(format!(
            "the stubs of robot {} have started no node since this daemon started; restart them, or compare with \
                another robot",
            present.robot
        )));
    }
    // Parameters of the push belong to the revision: the candidate gets its own with its nodes.
    let given: BTreeSet<&str> = linked.iter().flat_map(|one| one.given.iter().map(|(key, _)| key.as_str())).collect();
    let (from, to) = (there.bus(), candidate.bus());
    let failed = |error| Error::Reach(reach::Error::Bus(error));
    for key in from.parameters().map_err(failed)?.names().await.map_err(failed)? {
        let own = is_set_by_master(&key) || key.starts_with(RUNS);
        if own || given.contains(key.as_str()) {
            continue;
        }
        // Deleted meanwhile.
        let Ok(value) = from.parameter(&key).await else {
            continue;
        };
        let set = to.parameters().map_err(failed)?.set(&key, value).await;
        set.map_err(failed)?;
    }
    for one in &linked {
        candidate.start_stub_node(&one.node).await?;
    }
    let wanted = from.graph().borrow().clone();
    let names: Vec<&str> = linked.iter().map(|one| one.node.name.as_str()).collect();
    let mut graph = to.graph();
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
