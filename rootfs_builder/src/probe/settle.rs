//! Waiting: until nodes have registered, and until nothing changes any more.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use ros::bus::{ActionNodes, Graph, TopicNodes};
use ros::plumbing;
use tokio::sync::watch;
use tokio::time::{Instant, timeout_at};

use super::{ProbeError, ProbeOptions, Worked, describe};

async fn changed(watch: &mut watch::Receiver<Arc<Graph>>) -> Result<(), ProbeError> {
    watch.changed().await.map_err(|_| ProbeError::MasterGone)
}

/// Waits until all nodes that must register have; those that are elsewhere, with their names there.
pub(super) async fn registered(
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
                match elsewhere(&graph, node, options) {
                    Some(there) => drop(moved.insert(node.clone(), there.clone())),
                    None => missing.push(node.clone()),
                }
            }
        }
        if missing.is_empty() {
            return Ok(moved);
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

/// Where a node is that its program has put into a namespace: the one of its name among those of its mark.
fn elsewhere<'a>(graph: &'a Graph, node: &str, options: &ProbeOptions) -> Option<&'a String> {
    let last = |name: &str| name.rsplit('/').next().map(str::to_owned);
    let nodes = graph.enclaves.get(options.marks.get(node)?)?;
    nodes.iter().find(|other| last(other) == last(node))
}

/// Time as nodes have it: while they wait for a core it stands still, nearly.
struct Clock {
    /// When it was read last.
    at: Instant,
    worked: Option<Worked>,
}

/// What happened between two readings of a [`Clock`].
struct Past {
    /// As nodes have it.
    time: Duration,
    /// Of that on a core, of all threads together.
    ran: Duration,
}

/// Threads that wait together may wait longer than time passes: a part of it counts always.
const LEAST: u32 = 20;

impl Clock {
    async fn begin(options: &ProbeOptions) -> Self {
        Self {
            at: Instant::now(),
            worked: options.worked().await,
        }
    }

    async fn read(&mut self, options: &ProbeOptions) -> Past {
        let (at, worked) = (Instant::now(), options.worked().await);
        let elapsed = at - self.at;
        let (ran, waited) = match (self.worked, worked) {
            (Some(before), Some(after)) => (
                after.ran.saturating_sub(before.ran),
                // Threads that have ended are not counted any more.
                after.waited.saturating_sub(before.waited),
            ),
            _ => Default::default(),
        };
        *self = Self { at, worked };
        let time = elapsed.saturating_sub(waited).max(elapsed / LEAST);
        Past { time, ran }
    }
}

/// What a node answers; none where it does not within `limit` of its own time, or within `patience`.
pub(super) async fn answered<T>(
    limit: Duration,
    options: &ProbeOptions,
    answer: impl Future<Output = T>,
) -> Option<T> {
    let latest = Instant::now() + options.patience.max(limit);
    let mut clock = Clock::begin(options).await;
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

/// Waits until nothing changes any more; false when it did not come to rest in time.
///
/// Rest is more than silence: a node that shows nothing yet but itself, or that works hard, is still about to. A node
/// that waits for a core is, too: all times are the nodes' own, but for `patience`.
pub async fn still(
    watch: &mut watch::Receiver<Arc<Graph>>,
    options: &ProbeOptions,
) -> Result<bool, ProbeError> {
    let latest = Instant::now() + options.patience.max(options.restless);
    // Some nodes work all the time; that alone is not worth the whole wait.
    let working_limit = options.restless / 3;
    let mut clock = Clock::begin(options).await;
    let mut shape = shape(&watch.borrow_and_update());
    let mut total = Duration::ZERO;
    // Since the last change.
    let (mut silent, mut ran) = (Duration::ZERO, Duration::ZERO);
    loop {
        let pause = options.settle.saturating_sub(silent);
        let until = Instant::now() + pause.max(options.settle / LEAST);
        let changed = differs(watch, &mut shape, until.min(latest)).await?;
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

/// Waits until the graph differs from `shape`, which then is the new one; false if it does not until then.
async fn differs(
    watch: &mut watch::Receiver<Arc<Graph>>,
    shape: &mut Shape,
    until: Instant,
) -> Result<bool, ProbeError> {
    while let Ok(changed) = timeout_at(until, changed(watch)).await {
        changed?;
        // Parameters that a node reads again and again change the graph's generation and nothing here.
        let now = self::shape(&watch.borrow_and_update());
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

/// Whether nobody has registered anything yet but what every node has. (Of several nodes some may never show
/// anything, such as those that load nodelets into others.)
fn shows_nothing(graph: &Graph, options: &ProbeOptions) -> bool {
    const NODELETS: [&str; 3] = ["load_nodelet", "unload_nodelet", "list"];
    let own = |node: &String| *node == options.own_name;
    let topics = graph.topics.iter().any(|(name, topic)| {
        let mut ends = topic.publishers.iter().chain(&topic.subscribers);
        !plumbing::topic(graph, name) && ends.any(|node| !own(node))
    });
    let services = graph.services.iter().any(|(name, server)| {
        !own(server)
            && name
                .rsplit('/')
                .next()
                .is_some_and(|last| !NODELETS.contains(&last))
            && !plumbing::service(options.ros, graph, name)
    });
    let actions = graph.actions.values();
    let served = actions.flat_map(|action| &action.servers);
    !topics && !services && !served.into_iter().any(|node| !own(node))
}

/// What of a graph is looked at for changes.
pub(super) type Shape = (
    BTreeMap<String, TopicNodes>,
    BTreeMap<String, String>,
    BTreeMap<String, ActionNodes>,
    BTreeSet<String>,
    usize,
    usize,
);

pub(super) fn shape(graph: &Graph) -> Shape {
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
            names
                .map(|&name| (name.to_owned(), String::new()))
                .collect()
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
        let error = registered(&mut watch, &options).await.expect_err("no /see");
        assert!(error.to_string().starts_with("/see did not"), "{error}");
        let of_mark = ["/camera/help".to_owned(), "/camera/see".to_owned()];
        sender.send_replace(Arc::new(Graph {
            nodes: nodes(&[&beside[..], &["/camera/help", "/camera/see"]].concat()),
            enclaves: [("/mark".to_owned(), of_mark.into())].into(),
            ..graph
        }));
        let moved = registered(&mut watch, &options).await.expect("both");
        let expected = ("/see".to_owned(), "/camera/see".to_owned());
        assert_eq!(moved, [expected].into());
    }
}
