//! What a running servant is to a robot: its ROS graph, the rosbridge sessions and the links that use it, nodes that
//! stubs start and end, ways out, and when its interface is there.
//!
//! ```text
//!  container's namespace ─▶ sockets ─▶ Bus ─┬─▶ Bridge ◀─ rosbridge clients
//!                                           └─▶ Hub    ◀─ stubs' links ─▶ LinkedNodes ─▶ container
//!  hosts outside ◀─ relays ◀─ loopback addresses inside
//! ```
//!
//! It knows one servant at a time (a [`group`] knows those of one shared service), and of the rest of the daemon what
//! [`Observer`] and [`Tenant`] show. The rest of the daemon knows it as a [`Reach`], which an [`Opener`] gives for a servant of
//! its engine; [`LocalOpener`] is that of this host.

#![forbid(unsafe_code)]

pub mod components;
#[cfg(test)]
mod doubles;
pub mod egress;
mod endings;
mod ends;
mod following;
pub mod group;
mod in_process;
mod inside;
pub mod lifecycle;
pub mod links;
mod local;
pub mod master;
#[cfg(test)]
#[path = "../../../tests/support/memory_bus.rs"]
mod memory_bus;
#[cfg(test)]
#[path = "../../../tests/support/memory_container.rs"]
mod memory_container;
mod nodes;
pub mod readiness;
mod request_times;
mod sockets;
mod succession;
pub mod tap;
mod trial;

use std::collections::BTreeMap;
use std::sync::{Arc, Weak};
use std::time::{Duration, SystemTime};

use async_trait::async_trait;
use bridge::{BridgeOptions, Metrics, SessionEnd, SessionOptions, Waiting};
use budget::Budget;
use futures_util::future::BoxFuture;
use link::control::{Node, Request};
use link::session::Lost;
use package::interface::Interface;
use package::inventory::Inventory;
use ros::bus::{Bus, BusError, Graph, ParamValue, RosVersion};
use ros::flavour::Flavour;
use ros::ros2::composition::Component;
use ros::schema::Registry;
use ros::sizes::Seen;
use servant::engine::Servant;
use servant::spec::NodeSpec;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::watch;

use components::Loads;
use egress::Relays;
use lifecycle::Stages;
use links::{LinkStatus, RequestNews};
use tap::Tap;

pub use ends::how_it_ended;
pub use inside::Looked;
pub use local::LocalOpener;
pub use nodes::LinkedNodes;
pub use request_times::RequestTimes;
pub use trial::{Gap, Material, Pace, Picture, RECORDED, Replay, fits};

/// What is recorded of the revision that a servant was started from.
#[derive(Debug, Clone)]
pub struct Recorded {
    /// The service.
    pub service: String,
    /// The ROS package that was pushed.
    pub package: String,
    /// The ROS that the image is built for.
    pub flavour: Flavour,
    /// Environment of every process.
    pub environment: BTreeMap<String, String>,
    /// The revision's own nodes.
    pub nodes: Vec<NodeSpec>,
    /// Parameters that the deployer gave, absolute names.
    pub parameters: BTreeMap<String, ParamValue>,
    /// What is loaded into nodes that are component containers, by their names.
    pub components: BTreeMap<String, Vec<Component>>,
    /// What the image holds.
    pub inventory: Arc<Inventory>,
    /// Message definitions.
    pub registry: Arc<Registry>,
    /// `HOST:PORT`s that its nodes were granted.
    pub egress: Vec<String>,
}

/// The daemon, as one servant's reach sees it.
pub trait Observer: Send + Sync + 'static {
    /// Whether a stub that was made of the revision of this number, with this image, can use the servant; else why not.
    fn fits(&self, made_of: Option<u64>, image: &str) -> Result<(), String>;
    /// Something that the operator should know of the servant and its robot.
    fn event(&self, level: api::Level, kind: &str, message: &str, robot: Option<&str>);
    /// From `at` on a node of the robot is served by its local original, and why; none: by the cloud again.
    fn served_locally(&self, robot: &str, node: &str, at: SystemTime, why: Option<&str>);
    /// This has become known of a request, of one that was answered with the time and its parts.
    fn measured(&self, request: &Request, news: RequestNews);
}

/// Whom a servant serves: nobody while it is a warm container.
pub trait Tenant: Send + Sync + 'static {
    /// The robot's name.
    fn robot(&self) -> &str;
    /// The servant's limits.
    fn limits(&self) -> api::Limits;
    /// From now on the robot's stubs start and end the nodes; whether the revision's own nodes ran before.
    fn take_over(&self) -> bool;
}

/// Habits of one servant's reach.
#[derive(Debug, Clone)]
pub struct ReachOptions {
    /// What its nodes speak.
    pub ros: RosVersion,
    /// What `$ROS_DISTRO` stands for there, for a ROS that does not tell it; may be empty.
    pub distribution: String,
    /// Sessions of rosbridge.
    pub bridge: BridgeOptions,
    /// How long a link outlives its connection.
    pub grace: Duration,
    /// Memory held for the servant's nodes, links and clients.
    pub budget: Budget,
    /// Time from the first byte of a message or frame to its last.
    pub unfinished: Duration,
}

/// What went to nodes and came from them so far.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Flow {
    /// The node of a link; nothing: all nodes that rosbridge clients use.
    pub node: String,
    /// Messages, given while somebody listened, and calls.
    pub inputs: u64,
    /// Messages and answers that came of them.
    pub outputs: u64,
}

/// A node that a stub has started.
#[derive(Debug, Clone)]
pub struct Linked {
    /// As the stub said.
    pub node: Node,
    /// Parameters that its push gave it.
    pub given: Vec<(String, ParamValue)>,
}

/// A connection behind its upgrade.
pub type Stream = Box<dyn Io>;

/// What a [`Stream`] can do.
pub trait Io: AsyncRead + AsyncWrite + Send + Unpin {}

impl<T: AsyncRead + AsyncWrite + Send + Unpin> Io for T {}

/// What a running servant is to robots, wherever it runs: in this process over its namespace, or beside it in a pod, to which
/// all this is forwarded.
#[async_trait]
pub trait Reach: Send + Sync + 'static {
    /// Its ROS, for a group whose servants answer together.
    fn bus(&self) -> Arc<dyn Bus>;
    /// Nodes, topics and services as they are registered, now and later.
    fn graph(&self) -> watch::Receiver<Arc<Graph>>;
    /// Speaks rosbridge with a client that has waited for the servant, until it ends.
    async fn serve_rosbridge(&self, client: Waiting<Stream>, options: SessionOptions)
    -> SessionEnd;
    /// Speaks rosbridge with somebody who looks into it, until that ends: beside its robot, and none of its sessions.
    async fn serve_inside(&self, client: Waiting<Stream>, options: SessionOptions) -> SessionEnd;
    /// Its ROS for somebody who looks into it by another protocol; else code (RFC 6455) and reason to close with.
    async fn look_inside(&self) -> Result<Looked, (u16, String)>;
    /// Serves a stub's connection behind its upgrade, until it ends; `read_ahead` was read from it already.
    async fn serve_link(&self, stream: Stream, read_ahead: &[u8]) -> Lost;
    /// Where to hear what its robot asks of it; none where nobody can.
    fn tap(&self) -> Option<Arc<Tap>> {
        None
    }
    /// How its links are doing, by node.
    fn links(&self) -> Vec<LinkStatus>;
    /// Where its nodes are that have a lifecycle, now and later; none where its ROS knows none.
    fn lifecycles(&self) -> Option<watch::Receiver<Stages>> {
        None
    }
    /// How far its component containers are, now and later; none where nothing is loaded into any.
    fn loads(&self) -> Option<watch::Receiver<Loads>> {
        None
    }
    /// Nodes that stubs have started and that run.
    async fn linked(&self) -> Vec<Linked> {
        Vec::new()
    }
    /// Starts a node as a stub would, with the parameters that the push of this servant's revision gives it.
    async fn start_linked(&self, node: &Node) -> Result<(), Error> {
        Err(Error::Linked(format!(
            "{} is started by stubs alone",
            node.name
        )))
    }
    /// What flows, by who uses it.
    fn flows(&self) -> Vec<Flow> {
        Vec::new()
    }
    /// Tells whoever uses this [`Flow`] of something that is wrong with it.
    fn report(&self, _flow: &str, _what: &str) {}
    /// How large the messages and requests are that its robot sends to nodes, by topic or service.
    fn inputs(&self) -> Vec<(String, Seen)> {
        Vec::new()
    }
    /// What was counted of its rosbridge sessions.
    fn metrics(&self) -> &Metrics;
    /// Messages dropped because a client or the bridge was slow.
    fn dropped(&self) -> u64 {
        let metrics = self.metrics();
        metrics.dropped.get() + metrics.bus_dropped.get()
    }
    /// Dropped messages by topic, the most first: of rosbridge clients, and of links at both of their ends.
    fn drops(&self) -> Vec<(String, u64)> {
        let mut topics = self.metrics().drops.all();
        for link in self.links() {
            for drop in link.drops.iter().chain(&link.dropped) {
                *topics.entry(drop.topic.clone()).or_default() += drop.count;
            }
        }
        let mut topics: Vec<(String, u64)> = topics.into_iter().collect();
        topics.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
        topics
    }
    /// Gives it material, and tells what it answers and when.
    async fn replay(
        &self,
        service: &str,
        interface: &Interface,
        material: &Material,
        pace: &Pace,
    ) -> Result<Replay, Error>;
    /// From now on it serves this one.
    fn bind(&self, tenant: Weak<dyn Tenant>);
    /// Ends every rosbridge session, and refuses new ones, with these words.
    fn close_sessions(&self, reason: &str);
    /// Ends every session and every link, and refuses new ones, with these words.
    fn close(&self, reason: &str);
}

/// Reaches servants, wherever their engine has started them.
#[async_trait]
pub trait Opener: Send + Sync + 'static {
    /// Connects to the ROS of a running servant and sets a bridge before it. `recorded` is awaited meanwhile.
    async fn open(
        &self,
        servant: &Arc<dyn Servant>,
        recorded: BoxFuture<'_, Recorded>,
        options: ReachOptions,
        observer: Arc<dyn Observer>,
    ) -> Result<Arc<dyn Reach>, Error>;
    /// Connects to the ROS of a running servant as the node `name`, to find out what its nodes do.
    async fn look(
        &self,
        servant: &Arc<dyn Servant>,
        ros: RosVersion,
        name: &str,
        egress: &[String],
    ) -> Result<Look, Error>;
    /// Pids of a servant's processes as whoever looks at this machine sees them; none of one that runs elsewhere.
    fn processes(&self, servant: &str) -> Vec<i32>;
}

/// A bus of a servant that is looked at; hosts that its nodes connect to are reached for as long as this lives.
pub struct Look {
    /// Its ROS.
    pub bus: Arc<dyn Bus>,
    _relays: Relays,
}

/// Why a servant is not reached, or not tried.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Its ROS does not answer.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// It is none of the engine's that this reaches.
    #[error("servant {0} does not run here")]
    Elsewhere(String),
    /// A node of a stub cannot be started.
    #[error("{0}")]
    Linked(String),
    /// It cannot be tried with what was given.
    #[error("{0}")]
    Trial(String),
}
