//! Finds the interface of a running package by looking: no declaration is asked for.
//!
//! ```text
//!   nodes register ──▶ graph still ──▶ subscribe to all that is published ──▶ graph still? ──▶ ask for types,
//!        │ (or exit, or never)                    ▲                              │ no            parameters
//!        ▼                                        ├──────────────────────────────┘                   │
//!      error                                      └── graph changed? ◀── feed what is waited for ◀───┘
//! ```
//!
//! Many nodes register their inputs only while an output is subscribed to; those are the lazy ones. Others wait for
//! transforms, time, services or messages before they register the rest: they are given all that. What appears only
//! then is lazy as well, since a servant without a robot does not have it. An interface is described from the
//! package's point of view: what it subscribes to is an input.

mod describe;
mod feed;
mod frames;
mod heard;
mod incomplete;
mod lender;
mod plausible;
mod settle;

use std::collections::{BTreeMap, BTreeSet};
use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use futures_util::future::BoxFuture;
use package::interface::Interface;
use package::requests::Watched;
use parking_lot::Mutex;
use ros::bus::{Bus, Graph, Qos, RosVersion, Subscription, TopicNodes, WireType};
use ros::plumbing;
use ros::ros2::composition::{Component, Container, NotLoaded};
use ros::ros2::lifecycle::{self, Begun, NotBegun};
use ros::schema::Registry;
use tokio::sync::watch;
use tokio::time::Instant;

pub use settle::still;

use feed::Feed;
use heard::Heard;

/// Messages of an output that are kept between two looks.
const KEPT: usize = 8;
/// Each round gives what the one before has made a node ask for.
const MOST_ROUNDS: usize = 12;

/// What can go wrong while looking.
#[derive(Debug, thiserror::Error)]
pub enum ProbeError {
    /// A node ended before anything could be seen of it.
    #[error("{0}")]
    Exited(String),
    /// A node did not show up.
    #[error(
        "{} did not register with ROS within {after:?}: it may wait for something that is not there{} (see \
         its log); a parameter (--param) or an argument (--arg) may help",
        nodes.join(", "), services(sought)
    )]
    NeverRegistered {
        /// Their names.
        nodes: Vec<String>,
        /// How long was waited.
        after: Duration,
        /// Services that were looked for in vain.
        sought: Vec<String>,
    },
    /// The node was compiled with another definition than the image holds.
    #[error(
        "{what} has md5 {announced} on the wire, but {type_name} in the image gives {defined}: rebuild the package \
         against the definitions of its base"
    )]
    Mismatch {
        /// Topic, service or action.
        what: String,
        /// Its type.
        type_name: String,
        /// As the node announced it.
        announced: String,
        /// As the definition gives it.
        defined: String,
    },
    /// A definition is not there.
    #[error("{what}: {problem}; `--with DEB` adds a package that holds definitions")]
    NoDefinition {
        /// Topic, service or action.
        what: String,
        /// What is missing.
        problem: ros::schema::SchemaError,
    },
    /// The graph could not be watched any longer.
    #[error("the servant's ROS went away while its interface was looked at")]
    MasterGone,
    /// A node with a lifecycle does not begin its work.
    #[error(transparent)]
    Lifecycle(#[from] NotBegun),
    /// A component container does not load a node.
    #[error(transparent)]
    Component(#[from] NotLoaded),
}

fn services(sought: &[String]) -> String {
    match sought {
        [] => String::new(),
        names => format!(", such as the service {}", names.join(" or ")),
    }
}

/// How long to look.
#[derive(Debug, Clone)]
pub struct ProbeOptions {
    /// Nodes that must register.
    pub nodes: Vec<String>,
    /// Of those the ones that their programs may have put into a namespace (ROS 2), with the enclave by which they are known then.
    pub marks: BTreeMap<String, String>,
    /// Which ROS it is; the bus knows.
    pub ros: RosVersion,
    /// Name of the looking node, which is no part of what it sees.
    pub own_name: String,
    /// At most so long for nodes to register.
    pub patience: Duration,
    /// The graph is still when nothing changed for so long.
    pub settle: Duration,
    /// At most so long for it to become still, each time; time that the nodes waited for a core does not count, up to
    /// `patience`.
    pub restless: Duration,
    /// What is loaded into nodes that are component containers, by their names.
    pub components: BTreeMap<String, Vec<Component>>,
    /// Types of topics as the deployer states them, for inputs that take any.
    pub types: BTreeMap<String, String>,
    /// Tells how much the nodes have worked: those that work have not settled (they load models, say), and those that
    /// wait for a core could not. None: not known.
    pub work: Option<Work>,
}

/// What nodes have had of the processors so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Worked {
    /// Time on a core, of all threads together.
    pub ran: Duration,
    /// Time in which a thread could have run and others had the cores, of all threads together.
    pub waited: Duration,
}

/// Asks what the nodes have had of the processors; none where it cannot be told.
#[derive(Clone)]
pub struct Work(Arc<dyn Fn() -> BoxFuture<'static, Option<Worked>> + Send + Sync>);

impl Work {
    /// Asked several times a second at most.
    pub fn new<F>(ask: impl Fn() -> F + Send + Sync + 'static) -> Self
    where
        F: Future<Output = Option<Worked>> + Send + 'static,
    {
        Self(Arc::new(move || Box::pin(ask())))
    }
}

impl std::fmt::Debug for Work {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Work")
    }
}

impl ProbeOptions {
    /// With times that suit most packages.
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

    async fn worked(&self) -> Option<Worked> {
        match &self.work {
            Some(work) => (work.0)().await,
            None => None,
        }
    }
}

/// What was found.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Found {
    /// The interface.
    pub interface: Interface,
    /// Things to know that are no failure.
    pub warnings: Vec<String>,
    /// Outputs whose messages became longer and longer.
    pub growing: Vec<String>,
    /// Outputs that carried the stamp of what an input was given.
    pub watched: BTreeSet<Watched>,
    /// Nodes that their programs have put into a namespace, with the names that they have there.
    pub moved: BTreeMap<String, String>,
}

/// Looks. `exited` resolves when a node ends that should not, with what is to be said about it.
pub async fn probe(
    bus: &Arc<dyn Bus>,
    registry: &Registry,
    definitions: &BTreeMap<String, String>,
    options: &ProbeOptions,
    exited: impl Future<Output = String> + Send,
) -> Result<Found, ProbeError> {
    let unfed = Mutex::new(None);
    tokio::select! {
        // First: of a node that ended, nothing else is worth saying.
        biased;
        words = exited => match unfed.into_inner() {
            Some(found) => Ok(incomplete::ended(found, &words)),
            None => Err(ProbeError::Exited(words)),
        },
        found = look(bus, registry, definitions, options, &unfed) => found,
    }
}

async fn look(
    bus: &Arc<dyn Bus>,
    registry: &Registry,
    definitions: &BTreeMap<String, String>,
    options: &ProbeOptions,
    unfed: &Mutex<Option<Found>>,
) -> Result<Found, ProbeError> {
    let options = &ProbeOptions {
        ros: bus.version(),
        ..options.clone()
    };
    let mut watch = bus.graph();
    let moved = settle::registered(&mut watch, options).await?;
    tracing::debug!(?moved, "probe: all nodes are registered");
    let loaded = load_components(bus, registry, options).await?;
    let options = &ProbeOptions {
        nodes: {
            let there = |node| moved.get(node).unwrap_or(node).clone();
            options.nodes.iter().map(there).chain(loaded).collect()
        },
        ..options.clone()
    };
    settle::registered(&mut watch, options).await?;
    let idle = begin_lifecycles(bus, &mut watch, options).await?;
    let bus = &**bus;
    let mut feed = Feed::begin(bus, registry, options).await;
    let mut look = Look {
        bus,
        registry,
        definitions,
        options,
        watch,
        warnings: Vec::new(),
        subscriptions: BTreeMap::new(),
        tried: BTreeSet::new(),
        eager: BTreeSet::new(),
        heard: Heard::default(),
    };
    if !settle::still(&mut look.watch, options).await? {
        look.warnings.push(format!(
            "topics kept changing for {:?}: some may be missing",
            options.restless
        ));
    }
    tracing::debug!("probe: nothing changes");
    look.listen().await?;
    tracing::debug!(
        outputs = look.tried.len(),
        "probe: all outputs are listened to"
    );
    let mut bare = look.describe(&feed).await?;
    bare.moved = moved;
    tracing::debug!("probe: described as it is without a robot");
    // From here on a node may end of what it is given; then this is what is known of it.
    *unfed.lock() = Some(bare.clone());
    let mut found = bare.clone();
    for _ in 0..MOST_ROUNDS {
        let before = settle::shape(&look.graph());
        let Some(settle) = feed.give(&look.graph()).await else {
            break;
        };
        let options = ProbeOptions {
            settle,
            ..options.clone()
        };
        tracing::debug!(?settle, "probe: something is given");
        settle::still(&mut look.watch, &options).await?;
        let changed = settle::shape(&look.graph()) != before;
        tracing::debug!(changed, "probe: nothing changes");
        if !changed {
            continue;
        }
        look.listen().await?;
        let before = std::mem::take(&mut found.interface);
        found = look.describe(&feed).await?;
        found.moved.clone_from(&bare.moved);
        incomplete::keep_inputs(&mut found.interface, before);
        incomplete::mark_late(&mut found.interface, &bare.interface);
        *unfed.lock() = Some(found.clone());
    }
    look.hear();
    found.watched = look.heard.answers(|stamp| feed.stamped(stamp));
    incomplete::warn(&mut found, options, &mut feed);
    found.warnings.extend(idle);
    found.warnings.splice(..0, look.warnings);
    found.growing = look.heard.growing();
    Ok(found)
}

/// Has containers load what is to be loaded into them, each its own and all at the same time: the names of those nodes.
async fn load_components(
    bus: &Arc<dyn Bus>,
    registry: &Registry,
    options: &ProbeOptions,
) -> Result<Vec<String>, ProbeError> {
    let loading = options
        .components
        .iter()
        .map(|(name, components)| async move {
            let no_definition = |problem| ProbeError::NoDefinition {
                what: format!("container {name}"),
                problem,
            };
            let container =
                Container::of(Arc::clone(bus), registry, name).map_err(no_definition)?;
            let loaded = container.load_all(components, options.patience).await;
            loaded.map_err(ProbeError::from)
        });
    let loaded = futures_util::future::try_join_all(loading).await?;
    let names = loaded.into_iter().flatten();
    // Containers of others need not tell them.
    Ok(names.filter(|name| !name.is_empty()).collect())
}

/// Has nodes configure and activate themselves that nobody else drives: before that they show nothing. What is to be said
/// of those that are left as they are.
async fn begin_lifecycles(
    bus: &Arc<dyn Bus>,
    watch: &mut watch::Receiver<Arc<Graph>>,
    options: &ProbeOptions,
) -> Result<Vec<String>, ProbeError> {
    if bus.version() == RosVersion::One {
        return Ok(Vec::new());
    }
    // Services of a node are seen a moment after the node itself.
    settle::still(watch, options).await?;
    let begun = lifecycle::begin_all(bus, options.patience).await?;
    let left = begun.into_iter().filter_map(|(node, begun)| match begun {
        Begun::Left(state) if state != lifecycle::State::Active => Some(format!(
            "the lifecycle node {node} was {state} when it was looked at: something else drives it, and what it shows \
             later may be missing"
        )),
        _ => None,
    });
    Ok(left.collect())
}

/// One look at a running package.
struct Look<'a> {
    bus: &'a dyn Bus,
    registry: &'a Registry,
    definitions: &'a BTreeMap<String, String>,
    options: &'a ProbeOptions,
    watch: watch::Receiver<Arc<Graph>>,
    warnings: Vec<String>,
    subscriptions: BTreeMap<String, Subscription>,
    tried: BTreeSet<String>,
    eager: BTreeSet<String>,
    heard: Heard,
}

impl Look<'_> {
    fn graph(&mut self) -> Arc<Graph> {
        self.watch.borrow_and_update().clone()
    }

    /// Subscribes to everything that is published: that may wake inputs, and those may make the node publish more.
    async fn listen(&mut self) -> Result<(), ProbeError> {
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
                match self
                    .bus
                    .subscribe(topic, WireType::any(), Qos::keep_last(KEPT))
                    .await
                {
                    Ok(subscription) => {
                        self.subscriptions.insert(topic.clone(), subscription);
                    }
                    Err(error) => self
                        .warnings
                        .push(format!("{topic} cannot be subscribed to: {error}")),
                }
            }
            // A publisher that answers this has been connected to; what it then does takes about as long as it took
            // to answer. On a busy machine that is more than usual.
            for topic in &new {
                let _ = self.bus.topic_type(topic).await;
            }
            let settle = (asked.elapsed() * 2).clamp(self.options.settle, self.options.restless);
            let options = ProbeOptions {
                settle,
                ..self.options.clone()
            };
            settle::still(&mut self.watch, &options).await?;
        }
    }

    /// Takes what outputs have said since.
    fn hear(&mut self) {
        for (topic, subscription) in &mut self.subscriptions {
            while let Some(message) = subscription.messages.try_recv() {
                self.heard.note(topic, &message);
            }
        }
    }

    async fn describe(&mut self, feed: &Feed<'_>) -> Result<Found, ProbeError> {
        self.hear();
        let seen = describe::Seen {
            latched: self.heard.latched.clone(),
            eager: self.eager.clone(),
            graph: self.graph(),
            options: self.options,
            asked: feed.asked(),
            any: feed.any().clone(),
        };
        describe::describe(self.bus, self.registry, self.definitions, &seen).await
    }
}

/// Topics that the package publishes.
fn outputs(graph: &Graph, own: &str) -> BTreeSet<String> {
    ends(graph, |topic| {
        topic.publishers.iter().any(|node| node != own)
    })
}

/// Topics that the package subscribes to.
fn inputs(graph: &Graph, own: &str) -> BTreeSet<String> {
    ends(graph, |topic| {
        topic.subscribers.iter().any(|node| node != own)
    })
}

fn ends(graph: &Graph, pick: impl Fn(&TopicNodes) -> bool) -> BTreeSet<String> {
    let topics = graph
        .topics
        .iter()
        .filter(|(name, topic)| !plumbing::topic(graph, name) && pick(topic));
    topics.map(|(name, _)| name.clone()).collect()
}

#[cfg(test)]
mod tests;
