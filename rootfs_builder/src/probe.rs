//! Discovery of the interface of a running package by observation, without any declaration.
//!
//! ```text
//!   nodes register ──▶ graph stable ─▶ subscribe to all published topics ───▶ graph stable? ─▶ ask for types,
//!        │ (or exit, or never)                    ▲                              │ no            parameters
//!        ▼                                        ├──────────────────────────────┘                   │
//!      error                                      └── graph changed? ◀── feed the awaited inputs ◀────┘
//! ```
//!
//! Many nodes register their inputs only while an output has subscribers; these are the lazy ones. Others wait for
//! transforms, time, services or messages before they register the rest, so they are given all that. What appears only
//! then is lazy as well, since a servant without a robot does not have it. The interface is described from the
//! package's point of view: what it subscribes to is an input.

mod describe;
mod feed;
mod frames;
mod incomplete;
mod lender;
mod output_messages;
mod plausible;
mod settle;

use std::collections::{BTreeMap, BTreeSet};
use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use futures_util::future::BoxFuture;
use package::interface::Interface;
use package::requests::ObservedAnswer;
use parking_lot::Mutex;
use ros::bus::{Bus, Graph, QosProfile, RosVersion, Subscription, TopicNodes, WireType};
use ros::plumbing;
use ros::ros2::composition::{Component, ComponentContainer, NotLoaded};
use ros::ros2::lifecycle::{self, BeginError, BeginOutcome};
use ros::schema::Registry;
use tokio::sync::watch;
use tokio::time::Instant;

pub use settle::wait_until_still;

use feed::InputFeed;
use output_messages::OutputRecord;

/// Number of messages of an output kept between two observations.
const OUTPUT_HISTORY: usize = 8;
/// Maximum number of rounds; each provides what the previous one made a node request.
const MOST_ROUNDS: usize = 12;

/// Errors of probing.
#[derive(Debug, thiserror::Error)]
pub enum ProbeError {
    /// A node exited before its interface could be observed.
    #[error("{0}")]
    Exited(String),
    /// Nodes did not register.
    #[error(
        "{} did not register with ROS within {after:?}: it may be waiting for something that is missing{} (see its \
            log); a parameter (--param) or an argument (--arg) may help",
        nodes.join(", "), services(sought)
    )]
    NeverRegistered {
        /// Names of the nodes.
        nodes: Vec<String>,
        /// Time waited.
        after: Duration,
        /// Services that they looked up without success.
        sought: Vec<String>,
    },
    /// The node was compiled with another definition than that in the image.
    #[error(
        "{what} announces md5 {announced}, but {type_name} in the image has {defined}: rebuild the package against the \
            definitions of its base"
    )]
    Mismatch {
        /// Topic, service or action.
        what: String,
        /// Type.
        type_name: String,
        /// MD5 announced by the node.
        announced: String,
        /// MD5 of the definition.
        defined: String,
    },
    /// A definition is missing.
    #[error("{what}: {problem}; `--with DEB` adds a package with message definitions")]
    NoDefinition {
        /// Topic, service or action.
        what: String,
        /// Missing definition.
        problem: ros::schema::SchemaError,
    },
    /// The connection to the ROS graph was lost.
    #[error("the servant's ROS Master or domain ended during the inspection of its interface")]
    MasterGone,
    /// A lifecycle node cannot be activated.
    #[error(transparent)]
    Lifecycle(#[from] BeginError),
    /// A component container cannot load a component.
    #[error(transparent)]
    Component(#[from] NotLoaded),
}

fn services(sought: &[String]) -> String {
    match sought {
        [] => String::new(),
        names => format!(", such as the service {}", names.join(" or ")),
    }
}

/// Options of a probe.
#[derive(Debug, Clone)]
pub struct ProbeOptions {
    /// Nodes that must register.
    pub nodes: Vec<String>,
    /// Nodes whose programs may have chosen a namespace (ROS 2), with the enclave that identifies them.
    pub marks: BTreeMap<String, String>,
    /// ROS version; set from the bus.
    pub ros: RosVersion,
    /// Name of the observing node, which is ignored in the graph.
    pub own_name: String,
    /// Maximum time for nodes to register.
    pub patience: Duration,
    /// Time without changes after which the graph counts as settled.
    pub settle: Duration,
    /// Maximum time for the graph to settle, each time; time in which the nodes waited for a core does not count, up to
    /// `patience`.
    pub restless: Duration,
    /// Components to load into nodes that are component containers, by node name.
    pub components: BTreeMap<String, Vec<Component>>,
    /// Types stated by the deployer for topics of any type.
    pub types: BTreeMap<String, String>,
    /// Source of the nodes' CPU time: nodes that are busy (loading models, for example) have not settled, and nodes
    /// that wait for a core cannot settle. `None` if unknown.
    pub work: Option<CpuTimeSource>,
}

/// Accumulated CPU time of nodes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CpuTime {
    /// Time running on a core, summed over all threads.
    pub ran: Duration,
    /// Time runnable while waiting for a core, summed over all threads.
    pub waited: Duration,
}

/// Source of the nodes' CPU time; returns `None` if it cannot be determined.
#[derive(Clone)]
pub struct CpuTimeSource(Arc<dyn Fn() -> BoxFuture<'static, Option<CpuTime>> + Send + Sync>);

impl CpuTimeSource {
    /// Creates a source from a function, which is called at most several times a second.
    pub fn new<F>(ask: impl Fn() -> F + Send + Sync + 'static) -> Self
    where
        F: Future<Output = Option<CpuTime>> + Send + 'static,
    {
        Self(Arc::new(move || Box::pin(ask())))
    }
}

impl std::fmt::Debug for CpuTimeSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Work")
    }
}

impl ProbeOptions {
    /// Returns options with times that suit most packages.
    pub fn new(nodes: Vec<String>, own_name: &str) -> Self {
        Self {
            nodes,
            marks: BTreeMap::new(),
            ros: RosVersion::One,
            own_name: own_name.to_owned(),
            patience: Duration::from_secs(60),
            settle: Duration::from_millis(700),
            restless: Duration::from_secs(15),
            components: BTreeMap::new(),
            types: BTreeMap::new(),
            work: None,
        }
    }

    async fn cpu_time(&self) -> Option<CpuTime> {
        match &self.work {
            Some(work) => (work.0)().await,
            None => None,
        }
    }
}

/// Result of a probe.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ProbeResult {
    /// Discovered interface.
    pub interface: Interface,
    /// Warnings for the deployer.
    pub warnings: Vec<String>,
    /// Outputs whose messages grew steadily.
    pub growing: Vec<String>,
    /// Observed answers: outputs that carried the stamp of a message sent to an input.
    pub watched: BTreeSet<ObservedAnswer>,
    /// Nodes that their programs moved to a namespace, with their names there.
    pub moved: BTreeMap<String, String>,
}

/// Probes the interface. `exited` resolves with a description when a node exits unexpectedly.
pub async fn probe(
    bus: &Arc<dyn Bus>,
    registry: &Registry,
    definitions: &BTreeMap<String, String>,
    options: &ProbeOptions,
    exited: impl Future<Output = String> + Send,
) -> Result<ProbeResult, ProbeError> {
    let unfed = Mutex::new(None);
    tokio::select! {
        // Polled first: if a node has exited, no other error matters.
        biased;
        words = exited => match unfed.into_inner() {
            Some(found) => Ok(incomplete::with_exit_warning(found, &words)),
            None => Err(ProbeError::Exited(words)),
        },
        found = observe(bus, registry, definitions, options, &unfed) => found,
    }
}

async fn observe(
    bus: &Arc<dyn Bus>,
    registry: &Registry,
    definitions: &BTreeMap<String, String>,
    options: &ProbeOptions,
    unfed: &Mutex<Option<ProbeResult>>,
) -> Result<ProbeResult, ProbeError> {
    let options = &ProbeOptions { ros: bus.version(), ..options.clone() };
    let mut watch = bus.graph();
    let moved = settle::wait_until_registered(&mut watch, options).await?;
    tracing::debug!(?moved, "probe: all nodes are registered");
    let loaded = load_components(bus, registry, options).await?;
    let options = &ProbeOptions {
        nodes: {
            let there = |node| moved.get(node).unwrap_or(node).clone();
            options.nodes.iter().map(there).chain(loaded).collect()
        },
        ..options.clone()
    };
    settle::wait_until_registered(&mut watch, options).await?;
    let idle = activate_lifecycle_nodes(bus, &mut watch, options).await?;
    let bus = &**bus;
    let mut feed = InputFeed::start(bus, registry, options).await;
    let mut look = ProbeRun {
        bus,
        registry,
        definitions,
        options,
        watch,
        warnings: Vec::new(),
        subscriptions: BTreeMap::new(),
        tried: BTreeSet::new(),
        eager: BTreeSet::new(),
        heard: OutputRecord::default(),
    };
    if !settle::wait_until_still(&mut look.watch, options).await? {
        look.warnings.push(format!(
            "new topics, services, parameters or nodes kept appearing for {:?}, so some may be missing",
            options.restless
        ));
    }
    tracing::debug!("probe: nothing changes");
    look.subscribe_outputs().await?;
    tracing::debug!(outputs = look.tried.len(), "probe: all outputs are listened to");
    let mut bare = look.describe(&feed).await?;
    bare.moved = moved;
    tracing::debug!("probe: described as it is without a robot");
    // From here on a node may exit because of what it is given; then this is the result.
    *unfed.lock() = Some(bare.clone());
    let mut found = bare.clone();
    for _ in 0..MOST_ROUNDS {
        let before = settle::graph_shape(&look.graph());
        let Some(settle) = feed.give_inputs(&look.graph()).await else {
            break;
        };
        let options = ProbeOptions { settle, ..options.clone() };
        tracing::debug!(?settle, "probe: something is given");
        settle::wait_until_still(&mut look.watch, &options).await?;
        let changed = settle::graph_shape(&look.graph()) != before;
        tracing::debug!(changed, "probe: nothing changes");
        if !changed {
            continue;
        }
        look.subscribe_outputs().await?;
        let before = std::mem::take(&mut found.interface);
        found = look.describe(&feed).await?;
        found.moved.clone_from(&bare.moved);
        incomplete::keep_inputs(&mut found.interface, before);
        incomplete::mark_late(&mut found.interface, &bare.interface);
        *unfed.lock() = Some(found.clone());
    }
    look.read_messages();
    found.watched = look.heard.observed_answers(|stamp| feed.input_with_stamp(stamp));
    incomplete::add_warnings(&mut found, options, &mut feed);
    found.warnings.extend(idle);
    found.warnings.splice(..0, look.warnings);
    found.growing = look.heard.growing_outputs();
    Ok(found)
}

/// Loads the components into their containers, concurrently; returns the names of the nodes.
async fn load_components(
    bus: &Arc<dyn Bus>,
    registry: &Registry,
    options: &ProbeOptions,
) -> Result<Vec<String>, ProbeError> {
    let loading = options.components.iter().map(|(name, components)| async move {
        let no_definition = |problem| ProbeError::NoDefinition { what: format!("container {name}"), problem };
        let container = ComponentContainer::new(Arc::clone(bus), registry, name).map_err(no_definition)?;
        let loaded = container.load_all(components, options.patience).await;
        loaded.map_err(ProbeError::from)
    });
    let loaded = futures_util::future::try_join_all(loading).await?;
    let names = loaded.into_iter().flatten();
    // Other implementations of containers may not return the names.
    Ok(names.filter(|name| !name.is_empty()).collect())
}

/// Activates lifecycle nodes that nobody else manages, since they have no interface before. Returns warnings about
/// those that are left in another state.
async fn activate_lifecycle_nodes(
    bus: &Arc<dyn Bus>,
    watch: &mut watch::Receiver<Arc<Graph>>,
    options: &ProbeOptions,
) -> Result<Vec<String>, ProbeError> {
    if bus.version() == RosVersion::One {
        return Ok(Vec::new());
    }
    // Services of a node are discovered a moment after the node itself.
    settle::wait_until_still(watch, options).await?;
    let begun = lifecycle::begin_all(bus, options.patience).await?;
    let left = begun.into_iter().filter_map(|(node, begun)| match begun {
        BeginOutcome::Left(state) if state != lifecycle::State::Active => Some(format!(
            "the lifecycle node {node} was {state} during the inspection: another node manages it, and later topics \
                may be missing"
        )),
        _ => None,
    });
    Ok(left.collect())
}

/// State of a probe of a running package.
struct ProbeRun<'a> {
    bus: &'a dyn Bus,
    registry: &'a Registry,
    definitions: &'a BTreeMap<String, String>,
    options: &'a ProbeOptions,
    watch: watch::Receiver<Arc<Graph>>,
    warnings: Vec<String>,
    subscriptions: BTreeMap<String, Subscription>,
    tried: BTreeSet<String>,
    eager: BTreeSet<String>,
    heard: OutputRecord,
}

impl ProbeRun<'_> {
    fn graph(&mut self) -> Arc<Graph> {
        self.watch.borrow_and_update().clone()
    }

    /// Subscribes to all outputs, which may activate inputs, which in turn may add outputs.
    async fn subscribe_outputs(&mut self) -> Result<(), ProbeError> {
        let graph = self.graph();
        self.eager.extend(inputs(&graph, &self.options.own_name));
        loop {
            let graph = self.graph();
            let mut new = outputs(&graph, &self.options.own_name);
            new.retain(|topic| self.tried.insert(topic.clone()));
            if new.is_empty() {
                return Ok(());
            }
            let asked = Instant::now();
            for topic in &new {
                match self.bus.subscribe(topic, WireType::any(), QosProfile::keep_last(OUTPUT_HISTORY)).await {
                    Ok(subscription) => {
                        self.subscriptions.insert(topic.clone(), subscription);
                    }
                    Err(error) => self.warnings.push(format!("{topic} cannot be subscribed to: {error}")),
                }
            }
            // A publisher that answers this has processed the connection; its reaction takes about as long as the
            // answer did. On a busy machine that is longer than usual.
            for topic in &new {
                let _ = self.bus.topic_type(topic).await;
            }
            let settle = (asked.elapsed() * 2).clamp(self.options.settle, self.options.restless);
            let options = ProbeOptions { settle, ..self.options.clone() };
            settle::wait_until_still(&mut self.watch, &options).await?;
        }
    }

    /// Reads the messages received on outputs since the last call.
    fn read_messages(&mut self) {
        for (topic, subscription) in &mut self.subscriptions {
            while let Some(message) = subscription.messages.try_recv() {
                self.heard.record(topic, &message);
            }
        }
    }

    async fn describe(&mut self, feed: &InputFeed<'_>) -> Result<ProbeResult, ProbeError> {
        self.read_messages();
        let seen = describe::ObservedPackage {
            latched: self.heard.latched.clone(),
            eager: self.eager.clone(),
            graph: self.graph(),
            options: self.options,
            asked: feed.requested_services(),
            any: feed.any_type_inputs().clone(),
        };
        describe::describe(self.bus, self.registry, self.definitions, &seen).await
    }
}

/// Returns the topics that the package publishes.
fn outputs(graph: &Graph, own: &str) -> BTreeSet<String> {
    topics_where(graph, |topic| topic.publishers.iter().any(|node| node != own))
}

/// Returns the topics that the package subscribes to.
fn inputs(graph: &Graph, own: &str) -> BTreeSet<String> {
    topics_where(graph, |topic| topic.subscribers.iter().any(|node| node != own))
}

fn topics_where(graph: &Graph, pick: impl Fn(&TopicNodes) -> bool) -> BTreeSet<String> {
    let topics = graph.topics.iter().filter(|(name, topic)| !plumbing::is_builtin_topic(graph, name) && pick(topic));
    topics.map(|(name, _)| name.clone()).collect()
}

#[cfg(test)]
mod tests;
