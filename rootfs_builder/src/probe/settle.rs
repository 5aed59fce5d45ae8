//! Waiting until nodes have registered, and until the graph has settled.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use ros::bus::{ActionNodes, Graph, TopicNodes};
use ros::plumbing;
use tokio::sync::watch;
use tokio::time::{Instant, timeout_at};

use super::{CpuTime, ProbeError, ProbeOptions, describe};

async fn graph_changed(watch: &mut watch::Receiver<Arc<Graph>>) -> Result<(), ProbeError> {
    watch.changed().await.map_err(|_| ProbeError::MasterGone)
}

/// Waits until all required nodes have registered; returns those that have moved to a namespace, with their names
/// there.
pub(super) async fn wait_until_registered(
    watch: &mut watch::Receiver<Arc<Graph>>,
    options: &ProbeOptions,
) -> Result<BTreeMap<String, String>, ProbeError> {
    let deadline = Instant::now() + options.patience;
    loop {
        let (mut missing, mut moved) = (Vec::new(), BTreeMap::new());
        {
            let graph = watch.borrow_and_update();
            let nodes = options.nodes.iter();
            for node in nodes.filter(|node| !graph.nodes.contains_key(*node)) {
                match find_moved_node(&graph, node, options) {
                    Some(there) => drop(moved.insert(node.clone(), there.clone())),
                    None => missing.push(node.clone()),
                }
            }
        }
        if missing.is_empty() {
            return Ok(moved);
        }
        match timeout_at(deadline, graph_changed(watch)).await {
            Ok(result) => result?,
            Err(_) => {
                return Err(ProbeError::NeverRegistered {
                    nodes: missing,
                    after: options.patience,
                    sought: {
                        let needs = describe::missing_needs(&watch.borrow(), &options.own_name);
                        needs.into_iter().map(|need| need.name).collect()
                    },
                });
            }
        }
    }
}

/// Finds a node that its program has moved to a namespace: the node of the same base name with its mark.
fn find_moved_node<'a>(graph: &'a Graph, node: &str, options: &ProbeOptions) -> Option<&'a String> {
    let last = |name: &str| name.rsplit('/').next().map(str::to_owned);
    let nodes = graph.enclaves.get(options.marks.get(node)?)?;
    nodes.iter().find(|other| last(other) == last(node))
}

/// Clock of the nodes' own time, which nearly stands still while they wait for a core.
struct NodeClock {
    /// Time of the last reading.
    at: Instant,
    worked: Option<CpuTime>,
}

/// Time between two readings of a [`NodeClock`].
struct ClockReading {
    /// Elapsed time as seen by the nodes.
    time: Duration,
    /// Time running on a core, summed over all threads.
    ran: Duration,
}

/// Threads that wait together may wait longer than time elapses: at least 1/20 of the elapsed time always counts.
const LEAST: u32 = 20;

impl NodeClock {
    async fn start(options: &ProbeOptions) -> Self {
        Self { at: Instant::now(), worked: options.cpu_time().await }
    }

    async fn read(&mut self, options: &ProbeOptions) -> ClockReading {
        let (at, worked) = (Instant::now(), options.cpu_time().await);
        let elapsed = at - self.at;
        let (ran, waited) = match (self.worked, worked) {
            (Some(before), Some(after)) => (
                after.ran.saturating_sub(before.ran),
                // Threads that have ended are no longer included.
                after.waited.saturating_sub(before.waited),
            ),
            _ => Default::default(),
        };
        *self = Self { at, worked };
        let time = elapsed.saturating_sub(waited).max(elapsed / LEAST);
        ClockReading { time, ran }
    }
}

/// Awaits a node's answer; `None` if it takes longer than `limit` of its own time, or than `patience`.
pub(super) async fn await_answer<T>(
    limit: Duration,
    options: &ProbeOptions,
    answer: impl Future<Output = T>,
) -> Option<T> {
    let latest = Instant::now() + options.patience.max(limit);
    let mut clock = NodeClock::start(options).await;
    let mut left = limit;
    tokio::pin!(answer);
    loop {
        let until = Instant::now() + left.max(options.settle / LEAST);
        if let Ok(answer) = timeout_at(until.min(latest), answer.as_mut()).await {
            return Some(answer);
        }
        left = left.saturating_sub(clock.read(options).await.time);
        if left.is_zero() || Instant::now() >= latest {
            return None;
        }
    }
}

/// Waits until the graph has settled; returns false if it did not in time.
///
/// Settled means more than unchanged: a node that has registered nothing but itself, or that is busy, has not settled.
/// Neither has a node that waits for a core: all times except `patience` are the nodes' own.
pub async fn wait_until_still(
    watch: &mut watch::Receiver<Arc<Graph>>,
    options: &ProbeOptions,
) -> Result<bool, ProbeError> {
    let latest = Instant::now() + options.patience.max(options.restless);
    // Some nodes are always busy; that alone does not justify the whole wait.
    let working_limit = options.restless / 3;
    let mut clock = NodeClock::start(options).await;
    let mut shape = graph_shape(&watch.borrow_and_update());
    let mut total = Duration::ZERO;
    // Since the last change.
    let (mut silent, mut ran) = (Duration::ZERO, Duration::ZERO);
    loop {
        let pause = options.settle.saturating_sub(silent);
        let until = Instant::now() + pause.max(options.settle / LEAST);
        let changed = wait_for_difference(watch, &mut shape, until.min(latest)).await?;
        let past = clock.read(options).await;
        total += past.time;
        if changed {
            (silent, ran) = (Duration::ZERO, Duration::ZERO);
        } else {
            silent += past.time;
            ran += past.ran;
        }
        let busy = ran * 3 > silent;
        let bare = shows_nothing(&watch.borrow(), options);
        if total >= options.restless || Instant::now() >= latest {
            return Ok(!changed && (bare || !busy));
        }
        if silent < options.settle {
            continue;
        }
        if !bare && (!busy || total >= working_limit) {
            return Ok(true);
        }
        (silent, ran) = (Duration::ZERO, Duration::ZERO);
    }
}

/// Waits until the graph differs from `shape`, and updates that; returns false if it does not in time.
async fn wait_for_difference(
    watch: &mut watch::Receiver<Arc<Graph>>,
    shape: &mut GraphShape,
    until: Instant,
) -> Result<bool, ProbeError> {
    while let Ok(changed) = timeout_at(until, graph_changed(watch)).await {
        changed?;
        // A parameter that is read repeatedly changes the graph's generation, but nothing relevant here.
        let now = self::graph_shape(&watch.borrow_and_update());
        if now != *shape {
            *shape = now;
            return Ok(true);
        }
        if Instant::now() >= until {
            break;
        }
    }
    Ok(false)
}

/// Returns whether only what every node has is registered so far. (Of several nodes some may never have anything else,
/// such as those that load nodelets into others.)
fn shows_nothing(graph: &Graph, options: &ProbeOptions) -> bool {
    const NODELETS: [&str; 3] = ["load_nodelet", "unload_nodelet", "list"];
    let own = |node: &String| *node == options.own_name;
    let topics = graph.topics.iter().any(|(name, topic)| {
        let mut ends = topic.publishers.iter().chain(&topic.subscribers);
        !plumbing::is_builtin_topic(graph, name) && ends.any(|node| !own(node))
    });
    let services = graph.services.iter().any(|(name, server)| {
        !own(server)
            && name.rsplit('/').next().is_some_and(|last| !NODELETS.contains(&last))
            && !plumbing::is_builtin_service(options.ros, graph, name)
    });
    let actions = graph.actions.values();
    let served = actions.flat_map(|action| &action.servers);
    !topics && !services && !served.into_iter().any(|node| !own(node))
}

/// Parts of a graph that are watched for changes.
pub(super) type GraphShape = (
    BTreeMap<String, TopicNodes>,
    BTreeMap<String, String>,
    BTreeMap<String, ActionNodes>,
    BTreeSet<String>,
    usize,
    usize,
);

pub(super) fn graph_shape(graph: &Graph) -> GraphShape {
    let nodes = graph.nodes.keys().cloned().collect();
    (
        graph.topics.clone(),
        graph.services.clone(),
        graph.actions.clone(),
        nodes,
        graph.parameters.len(),
        graph.sought.len(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_node_that_its_program_puts_elsewhere_is_known_by_its_mark() {
        let nodes = |names: &[&str]| {
            let names = names.iter();
            names.map(|&name| (name.to_owned(), String::new())).collect()
        };
        let beside = ["/hear", "/other/see", "/rear/hear"];
        let graph = Graph {
            nodes: nodes(&beside),
            enclaves: [("/other".to_owned(), ["/other/see".to_owned()].into())].into(),
            ..Graph::default()
        };
        let (sender, mut watch) = watch::channel(Arc::new(graph.clone()));
        let options = ProbeOptions {
            patience: Duration::from_millis(100),
            marks: [("/see".to_owned(), "/mark".to_owned())].into(),
            ..ProbeOptions::new(vec!["/see".to_owned(), "/hear".to_owned()], "/probe")
        };
        let error = wait_until_registered(&mut watch, &options).await.expect_err("no /see");
        assert!(error.to_string().starts_with("/see did not"), "{error}");
        let of_mark = ["/camera/help".to_owned(), "/camera/see".to_owned()];
        sender.send_replace(Arc::new(Graph {
            nodes: nodes(&[&beside[..], &["/camera/help", "/camera/see"]].concat()),
            enclaves: [("/mark".to_owned(), of_mark.into())].into(),
            ..graph
        }));
        let moved = wait_until_registered(&mut watch, &options).await.expect("both");
        let expected = ("/see".to_owned(), "/camera/see".to_owned());
        assert_eq!(moved, [expected].into());
    }
}
