//! Waiting: until nodes have registered, and until nothing changes any more.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use ros::bus::{Graph, TopicNodes};
use tokio::sync::watch;
use tokio::time::{Instant, timeout_at};

use super::{ProbeError, ProbeOptions, describe, is_plumbing};

async fn changed(watch: &mut watch::Receiver<Arc<Graph>>) -> Result<(), ProbeError> {
    watch.changed().await.map_err(|_| ProbeError::MasterGone)
}

/// Waits until all nodes that must register have.
pub(super) async fn registered(
    watch: &mut watch::Receiver<Arc<Graph>>,
    options: &ProbeOptions,
) -> Result<(), ProbeError> {
    let deadline = Instant::now() + options.patience;
    loop {
        let missing: Vec<String> = {
            let graph = watch.borrow_and_update();
            options
                .nodes
                .iter()
                .filter(|node| !graph.nodes.contains_key(*node))
                .cloned()
                .collect()
        };
        if missing.is_empty() {
            return Ok(());
        }
        match timeout_at(deadline, changed(watch)).await {
            Ok(result) => result?,
            Err(_) => {
                return Err(ProbeError::NeverRegistered {
                    nodes: missing,
                    after: options.patience,
                    sought: {
                        let needs = describe::needs(&watch.borrow(), &options.own_name);
                        needs.into_iter().map(|need| need.name).collect()
                    },
                });
            }
        }
    }
}

/// Waits until nothing changes any more; false when it did not come to rest in time.
///
/// Rest is more than silence: a node that shows nothing yet but itself, or that works hard, is still about to.
pub(super) async fn still(
    watch: &mut watch::Receiver<Arc<Graph>>,
    options: &ProbeOptions,
) -> Result<bool, ProbeError> {
    let begun = Instant::now();
    let limit = begun + options.restless;
    // Some nodes work all the time; that alone is not worth the whole wait.
    let working_limit = begun + options.restless / 3;
    let mut shape = shape(&watch.borrow_and_update());
    let mut since = Instant::now();
    let mut worked = options.worked().await;
    loop {
        match timeout_at((since + options.settle).min(limit), changed(watch)).await {
            Ok(result) => {
                result?;
                // Parameters that a node reads again and again change the graph's generation and nothing here.
                let now = self::shape(&watch.borrow_and_update());
                if now == shape {
                    continue;
                }
                shape = now;
            }
            Err(_) => {
                let now = Instant::now();
                let work = options.worked().await;
                let busy = match (worked, work) {
                    (Some(before), Some(after)) => after.saturating_sub(before) * 3 > now - since,
                    _ => false,
                };
                worked = work;
                let bare = shows_nothing(&watch.borrow(), options);
                if now >= limit {
                    return Ok(bare || !busy);
                }
                if !bare && (!busy || now >= working_limit) {
                    return Ok(true);
                }
            }
        }
        since = Instant::now();
    }
}

/// Whether nobody has registered anything yet but what every node has. (Of several nodes some may never show
/// anything, such as those that load nodelets into others.)
fn shows_nothing(graph: &Graph, options: &ProbeOptions) -> bool {
    const SERVICES: [&str; 5] = [
        "get_loggers",
        "set_logger_level",
        "load_nodelet",
        "unload_nodelet",
        "list",
    ];
    let own = |node: &String| *node == options.own_name;
    let topics = graph.topics.iter().any(|(name, topic)| {
        let mut ends = topic.publishers.iter().chain(&topic.subscribers);
        !is_plumbing(name, topic) && ends.any(|node| !own(node))
    });
    let services = graph.services.iter().any(|(name, server)| {
        !own(server)
            && name
                .rsplit('/')
                .next()
                .is_some_and(|last| !SERVICES.contains(&last))
    });
    !topics && !services
}

/// What of a graph is looked at for changes.
pub(super) type Shape = (
    BTreeMap<String, TopicNodes>,
    BTreeMap<String, String>,
    BTreeSet<String>,
    usize,
    usize,
);

pub(super) fn shape(graph: &Graph) -> Shape {
    let nodes = graph.nodes.keys().cloned().collect();
    (
        graph.topics.clone(),
        graph.services.clone(),
        nodes,
        graph.parameters.len(),
        graph.sought.len(),
    )
}
