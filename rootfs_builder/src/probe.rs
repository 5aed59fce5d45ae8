//! Finds the interface of a running package by looking: no declaration is asked for.
//!
//! ```text
//!   nodes register ──▶ graph still ──▶ subscribe to all that is published ──▶ graph still? ──▶ ask for types,
//!        │ (or exit, or never)                    ▲                              │ no            parameters
//!        ▼                                        └──────────────────────────────┘
//!      error
//! ```
//!
//! Many nodes register their inputs only while an output is subscribed to; those are the lazy ones. An interface is
//! described from the package's point of view: what it subscribes to is an input.

mod describe;

use std::collections::{BTreeMap, BTreeSet};
use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use futures_util::future::BoxFuture;
use package::interface::Interface;
use ros::bus::{Bus, Graph, SubscribeOptions, Subscription, TopicNodes};
use ros::schema::Registry;
use tokio::sync::watch;
use tokio::time::{Instant, timeout_at};

/// What can go wrong while looking.
#[derive(Debug, thiserror::Error)]
pub enum ProbeError {
    /// A node ended before anything could be seen of it.
    #[error("{0}")]
    Exited(String),
    /// A node did not show up.
    #[error(
        "{} did not register with the ROS Master within {after:?}: it may wait for something that is not there{} (see \
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
    #[error("the servant's ROS Master went away while its interface was looked at")]
    MasterGone,
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
    /// Name of the looking node, which is no part of what it sees.
    pub own_name: String,
    /// At most so long for nodes to register.
    pub patience: Duration,
    /// The graph is still when nothing changed for so long.
    pub settle: Duration,
    /// At most so long for it to become still, each time.
    pub restless: Duration,
    /// Tells how much the nodes have worked: those that work have not settled (they load models, say). None: not
    /// known.
    pub work: Option<Work>,
}

/// Asks for the CPU time that the nodes have used so far; none where it cannot be told.
#[derive(Clone)]
pub struct Work(Arc<dyn Fn() -> BoxFuture<'static, Option<Duration>> + Send + Sync>);

impl Work {
    /// Asked several times a second at most.
    pub fn new<F>(ask: impl Fn() -> F + Send + Sync + 'static) -> Self
    where
        F: Future<Output = Option<Duration>> + Send + 'static,
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
            own_name: own_name.to_owned(),
            patience: Duration::from_secs(60),
            settle: Duration::from_millis(700),
            restless: Duration::from_secs(15),
            work: None,
        }
    }

    async fn worked(&self) -> Option<Duration> {
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
}

/// Looks. `exited` resolves when a node ends that should not, with what is to be said about it.
pub async fn probe(
    bus: &dyn Bus,
    registry: &Registry,
    definitions: &BTreeMap<String, String>,
    options: &ProbeOptions,
    exited: impl Future<Output = String> + Send,
) -> Result<Found, ProbeError> {
    tokio::select! {
        // First: of a node that ended, nothing else is worth saying.
        biased;
        words = exited => Err(ProbeError::Exited(words)),
        found = look(bus, registry, definitions, options) => found,
    }
}

async fn look(
    bus: &dyn Bus,
    registry: &Registry,
    definitions: &BTreeMap<String, String>,
    options: &ProbeOptions,
) -> Result<Found, ProbeError> {
    let mut watch = bus.graph();
    registered(&mut watch, options).await?;
    let mut warnings = Vec::new();
    if !still(&mut watch, options).await? {
        warnings.push(format!(
            "topics kept changing for {:?}: some may be missing",
            options.restless
        ));
    }
    let eager = inputs(&watch.borrow_and_update(), &options.own_name);
    // Subscribing may wake inputs, and those may make the node publish more.
    let mut subscriptions: BTreeMap<String, Subscription> = BTreeMap::new();
    let mut tried = BTreeSet::new();
    loop {
        let graph = watch.borrow_and_update().clone();
        let mut new = outputs(&graph, &options.own_name);
        new.retain(|topic| tried.insert(topic.clone()));
        if new.is_empty() {
            break;
        }
        let asked = Instant::now();
        for topic in &new {
            match bus
                .subscribe(
                    topic,
                    SubscribeOptions {
                        wire_type: None,
                        queue: 1,
                    },
                )
                .await
            {
                Ok(subscription) => {
                    subscriptions.insert(topic.clone(), subscription);
                }
                Err(error) => warnings.push(format!("{topic} cannot be subscribed to: {error}")),
            }
        }
        // A publisher that answers this has been connected to; what it then does takes about as long as it took to
        // answer. On a busy machine that is more than usual.
        for topic in &new {
            let _ = bus.topic_type(topic).await;
        }
        let settle = (asked.elapsed() * 2).clamp(options.settle, options.restless);
        still(
            &mut watch,
            &ProbeOptions {
                settle,
                ..options.clone()
            },
        )
        .await?;
    }
    let graph = watch.borrow_and_update().clone();
    let latched = subscriptions
        .iter_mut()
        .filter_map(|(topic, subscription)| {
            let message = subscription.messages.try_recv()?;
            message.latching.then(|| topic.clone())
        });
    let seen = describe::Seen {
        latched: latched.collect(),
        eager,
        graph,
        own_name: &options.own_name,
    };
    let mut found = describe::describe(bus, registry, definitions, &seen).await?;
    found.warnings.splice(..0, warnings);
    Ok(found)
}

async fn changed(watch: &mut watch::Receiver<Arc<Graph>>) -> Result<(), ProbeError> {
    watch.changed().await.map_err(|_| ProbeError::MasterGone)
}

/// Waits until all nodes that must register have.
async fn registered(
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
async fn still(
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

type Shape = (
    BTreeMap<String, TopicNodes>,
    BTreeMap<String, String>,
    BTreeSet<String>,
    usize,
    usize,
);

fn shape(graph: &Graph) -> Shape {
    let nodes = graph.nodes.keys().cloned().collect();
    (
        graph.topics.clone(),
        graph.services.clone(),
        nodes,
        graph.parameters.len(),
        graph.sought.len(),
    )
}

/// ROS's own plumbing, which no robot asks for: logs, statistics, simulated time, the life lines of nodelets.
fn is_plumbing(name: &str, topic: &TopicNodes) -> bool {
    matches!(name, "/rosout" | "/rosout_agg" | "/statistics" | "/clock")
        || topic.type_name == "bond/Status"
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
        .filter(|(name, topic)| !is_plumbing(name, topic) && pick(topic));
    topics.map(|(name, _)| name.clone()).collect()
}

#[cfg(test)]
mod tests;
