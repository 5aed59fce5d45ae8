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
const COUNTED_DIVISOR: u32 = 20;

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
        let time = elapsed.saturating_sub(waited).max(elapsed / COUNTED_DIVISOR);
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
        let until = Instant::now() + left.max(options.settle / COUNTED_DIVISOR);
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
/// Settled means that nothing appears that was not there before: what comes and goes (a subscription that a node makes
/// for each lookup, a listener node with a new number each time) is known once it has come, and nothing would be learnt
/// by waiting for its end. But a node that has registered nothing but itself, or that is busy, has not settled. Neither
/// has a node that waits for a core: all times except `patience` are the nodes' own.
pub async fn wait_until_still(
    watch: &mut watch::Receiver<Arc<Graph>>,
    options: &ProbeOptions,
) -> Result<bool, ProbeError> {
    let latest = Instant::now() + options.patience.max(options.restless);
    // Some nodes are always busy; that alone does not justify the whole wait.
    let working_limit = options.restless / 3;
    let mut clock = NodeClock::start(options).await;
    let mut shown = ShownNames::default();
    shown.add(&watch.borrow_and_update(), &options.own_name);
    let mut total = Duration::ZERO;
    // Since the last change.
    let (mut silent, mut ran) = (Duration::ZERO, Duration::ZERO);
    loop {
        let pause = options.settle.saturating_sub(silent);
        let until = Instant::now() + pause.max(options.settle / COUNTED_DIVISOR);
        let changed = wait_for_news(watch, &mut shown, &options.own_name, until.min(latest)).await?;
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

/// Waits until the graph has something that was not `shown` before, and adds it; returns false if it does not in time.
async fn wait_for_news(
    watch: &mut watch::Receiver<Arc<Graph>>,
    shown: &mut ShownNames,
    own: &str,
    until: Instant,
) -> Result<bool, ProbeError> {
    while let Ok(changed) = timeout_at(until, graph_changed(watch)).await {
        changed?;
        if shown.add(&watch.borrow_and_update(), own) {
            return Ok(true);
        }
        if Instant::now() >= until {
            break;
        }
    }
    Ok(false)
}

/// A name in the graph, by its role. Which node it belongs to does not matter for the interface.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
enum ShownName {
    Published(String),
    Subscribed(String),
    Service(String),
    ActionServer(String),
    ActionClient(String),
    Sought(String),
    Parameter(String),
    /// Name of a node, without the number of an anonymous one.
    Node(String),
}

/// All names that the nodes of the package have shown so far.
#[derive(Debug, Default)]
struct ShownNames(BTreeSet<ShownName>);

impl ShownNames {
    /// Adds the names in a graph, except those of the node `own`; returns whether any is new.
    fn add(&mut self, graph: &Graph, own: &str) -> bool {
        let before = self.0.len();
        let others = |nodes: &[String]| nodes.iter().any(|node| node != own);
        for (name, topic) in &graph.topics {
            self.insert_if(others(&topic.publishers), ShownName::Published, name);
            self.insert_if(others(&topic.subscribers), ShownName::Subscribed, name);
        }
        for (name, server) in &graph.services {
            self.insert_if(server != own, ShownName::Service, name);
        }
        for (name, action) in &graph.actions {
            self.insert_if(others(&action.servers), ShownName::ActionServer, name);
            self.insert_if(others(&action.clients), ShownName::ActionClient, name);
        }
        for (name, nodes) in &graph.sought {
            self.insert_if(others(nodes), ShownName::Sought, name);
        }
        for name in graph.parameters.keys() {
            self.insert_if(true, ShownName::Parameter, name);
        }
        for node in graph.nodes.keys() {
            self.insert_if(node != own, ShownName::Node, without_number(node));
        }
        self.0.len() > before
    }

    fn insert_if(&mut self, is_shown: bool, role: fn(String) -> ShownName, name: &str) {
        if is_shown {
            self.0.insert(role(name.to_owned()));
        }
    }
}

/// Returns the name of a node without the number that makes anonymous nodes unique: decimal digits at its end, or a
/// hexadecimal number behind an underscore (`transform_listener_impl_55d0a8e1f2b0`, of tf2_ros).
fn without_number(node: &str) -> &str {
    /// Length from which letters up to `f` beside digits are taken for a number.
    const MIN_HEX_LENGTH: usize = 4;
    let is_number = |end: &str| {
        let digits = end.bytes().filter(u8::is_ascii_digit).count();
        digits > 0 && end.len() >= MIN_HEX_LENGTH && end.bytes().all(|it| it.is_ascii_hexdigit())
    };
    match node.rsplit_once('_') {
        Some((before, number)) if is_number(number) => before,
        _ => node.trim_end_matches(|char: char| char.is_ascii_digit()),
    }
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

/// Parts of a graph in which two observations are compared.
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

    /// A graph in which `/package` publishes these topics, and these nodes subscribe to `/tf`.
    fn graph_of(topics: &[&str], listeners: &[&str]) -> Arc<Graph> {
        let publishers = vec!["/package".to_owned()];
        let published = topics.iter().map(|&name| {
            let nodes = TopicNodes { publishers: publishers.clone(), ..TopicNodes::default() };
            (name.to_owned(), nodes)
        });
        let subscribers: Vec<String> = listeners.iter().map(|&name| name.to_owned()).collect();
        let nodes = subscribers.iter().chain(&publishers).map(|name| (name.clone(), String::new())).collect();
        let transforms = ("/tf".to_owned(), TopicNodes { subscribers, ..TopicNodes::default() });
        Arc::new(Graph { topics: published.chain([transforms]).collect(), nodes, ..Graph::default() })
    }

    /// Shows these graphs again and again, one each 100 ms; returns whether the graph settled, and after which time.
    async fn settle_among(graphs: impl Fn(u32) -> Arc<Graph> + Send + 'static) -> (bool, Duration) {
        let (sender, mut watch) = watch::channel(graphs(0));
        let changing = tokio::spawn(async move {
            for turn in 1.. {
                tokio::time::sleep(Duration::from_millis(100)).await;
                sender.send_replace(graphs(turn));
            }
        });
        let begun = Instant::now();
        let options = ProbeOptions::new(vec!["/package".to_owned()], "/probe");
        let is_still = wait_until_still(&mut watch, &options).await.expect("watched");
        changing.abort();
        (is_still, begun.elapsed())
    }

    #[tokio::test(start_paused = true)]
    async fn what_comes_and_goes_keeps_nothing_from_settling() {
        let soon = Duration::from_secs(2);
        // A listener for each lookup, which has another number each time, and a topic that is there half of the time.
        let graphs = |turn| match turn % 2 {
            0 => graph_of(&["/pose"], &[]),
            _ => graph_of(&["/pose", "/debug"], &[&format!("/transform_listener_impl_{:012x}", 0x55d0_0000 + turn)]),
        };
        let (is_still, took) = settle_among(graphs).await;
        assert!(is_still && took < soon, "{is_still} after {took:?}");
        // Topics that were never seen before.
        let growing = |turn| graph_of(&[&format!("/object_{turn}")], &[]);
        let (is_still, took) = settle_among(growing).await;
        assert!(!is_still && took >= Duration::from_secs(15), "{is_still} after {took:?}");
    }

    #[test]
    fn anonymous_nodes_are_known_without_their_numbers() {
        for (node, known) in [
            ("/transform_listener_impl_55d0a8e1f2b0", "/transform_listener_impl"),
            ("/launch_ros_4711", "/launch_ros"),
            ("/relay12", "/relay"),
            ("/left_face", "/left_face"),
            ("/camera_1", "/camera_"),
            ("/wheel_speed", "/wheel_speed"),
        ] {
            assert_eq!(without_number(node), known);
        }
    }

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
