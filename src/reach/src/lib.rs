//! Access of robots to a running servant: its ROS graph, the rosbridge sessions and links that use it, the nodes that
//! stubs start and stop, egress, and readiness.
//!
//! ```text
//!  container's namespace ─▶ sockets ─▶ Bus ─┬─▶ Bridge ◀─ rosbridge clients
//!                                           └─▶ Hub    ◀─ stubs' links ─▶ LinkedNodes ─▶ container
//!  hosts outside ◀─ relays ◀─ loopback addresses inside
//! ```
//!
//! The crate knows one servant at a time (a [`group`] knows those of one shared service), and of the rest of the daemon
//! what [`Observer`] and [`Tenant`] show. The daemon uses it through a [`Reach`], which an [`Opener`] opens for a
//! servant of its engine; [`LocalOpener`] is the one for this host.

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
mod observer;
pub mod readiness;
mod request_times;
mod sockets;
mod succession;
pub mod tap;
mod trial;

use std::collections::BTreeMap;
use std::sync::{Arc, Weak};
use std::time::Duration;

use async_trait::async_trait;
use bridge::{BridgeOptions, MetricsSnapshot, SessionEnd, SessionOptions, WaitingConnection};
use budget::Budget;
use futures_util::future::BoxFuture;
use package::interface::Interface;
use package::inventory::Inventory;
use ros::bus::{Bus, BusError, Graph, ParamValue, RosVersion};
use ros::flavour::Flavour;
use ros::ros2::composition::Component;
use ros::schema::Registry;
use ros::sizes::SizeSummary;
use servant::engine::ServantHandle;
use servant::spec::NodeSpec;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::watch;
use translation::TranslationRules;

use components::Loads;
use lifecycle::Stages;
use links::{LinkStatus, NodeError};
use tap::TapReceiver;

pub use ends::describe_exit;
pub use inside::InsideView;
pub use links::StubSetup;
pub use local::LocalOpener;
pub use nodes::LinkedNodes;
pub use observer::{Observer, Tenant};
pub use request_times::RequestTimes;
pub use sockets::ServantSockets;
pub use trial::{MAX_RECORDED, Material, Picture, Replay, ReplayPace, RequestGap, check_material};

/// Recorded data of the revision from which a servant was started.
#[derive(Debug, Clone)]
pub struct RecordedRevision {
    /// Name of the service.
    pub service: String,
    /// ROS package that was pushed.
    pub package: String,
    /// ROS version and distribution of the image.
    pub flavour: Flavour,
    /// Environment variables of every process.
    pub environment: BTreeMap<String, String>,
    /// The revision's own nodes.
    pub nodes: Vec<NodeSpec>,
    /// Parameters given by the deployer, by absolute name.
    pub parameters: BTreeMap<String, ParamValue>,
    /// Components to load into component containers, by container name.
    pub components: BTreeMap<String, Vec<Component>>,
    /// Inventory of the image.
    pub inventory: Arc<Inventory>,
    /// Interface that the push has recorded.
    pub interface: Arc<Interface>,
    /// Message definitions.
    pub registry: Arc<Registry>,
    /// Granted egress, as `HOST:PORT`.
    pub egress: Vec<String>,
}

/// Options of one servant's reach.
#[derive(Debug, Clone)]
pub struct ReachOptions {
    /// ROS version of its nodes.
    pub ros: RosVersion,
    /// Value of `$ROS_DISTRO`, for a ROS that does not report it; may be empty.
    pub distribution: String,
    /// Options of rosbridge sessions.
    pub bridge: BridgeOptions,
    /// Time for which a link outlives its connection.
    pub grace: Duration,
    /// Memory budget for the servant's nodes, links and clients.
    pub budget: Budget,
    /// Maximum time from the first to the last byte of a message or frame.
    pub unfinished: Duration,
    /// Rules for types whose counterparts in the other ROS are not obvious.
    pub rules: Arc<TranslationRules>,
}

/// Counts of what was sent to nodes and received from them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FlowCounts {
    /// Node of a link; empty: all nodes used by rosbridge clients.
    pub node: String,
    /// Messages, sent while somebody subscribed to an output, and calls.
    pub inputs: u64,
    /// Messages and responses received.
    pub outputs: u64,
}

/// A connection after its WebSocket upgrade.
pub type UpgradedStream = Box<dyn Io>;

/// Requirements on an [`UpgradedStream`].
pub trait Io: AsyncRead + AsyncWrite + Send + Unpin {}

impl<T: AsyncRead + AsyncWrite + Send + Unpin> Io for T {}

/// A running servant as seen by robots, independent of where it runs: in this process over its network namespace, or in
/// a pod to which everything is forwarded.
#[async_trait]
pub trait Reach: Send + Sync + 'static {
    /// Returns its bus, for a group of servants.
    fn bus(&self) -> Arc<dyn Bus>;
    /// Returns a watch on its ROS graph.
    fn graph(&self) -> watch::Receiver<Arc<Graph>>;
    /// Serves a rosbridge client that has waited for the servant, until it ends.
    async fn serve_rosbridge(&self, client: WaitingConnection<UpgradedStream>, options: SessionOptions) -> SessionEnd;
    /// Serves a rosbridge client of somebody who looks inside, until it ends. Independent of the robot and not one of
    /// its sessions.
    async fn serve_inside(&self, client: WaitingConnection<UpgradedStream>, options: SessionOptions) -> SessionEnd;
    /// Returns its ROS graph for a viewer of another protocol, or the close code (RFC 6455) and reason.
    async fn open_inside(&self) -> Result<InsideView, (u16, String)>;
    /// Serves a stub's connection after its upgrade until it ends; returns the reason. `read_ahead` was already read
    /// from it. It is closed with the reason that `end` gives.
    async fn serve_link(&self, stream: UpgradedStream, read_ahead: &[u8], end: BoxFuture<'_, String>) -> String;
    /// Starts listening to the robot's requests; what is heard is charged to `budget`. Returns `None` if somebody
    /// listens already.
    async fn tap(&self, _budget: &Budget) -> Option<TapReceiver> {
        None
    }
    /// Returns the status of its links by node.
    fn links(&self) -> Vec<LinkStatus>;
    /// Returns a watch on the lifecycle states of its nodes; empty if its ROS version has none.
    fn lifecycles(&self) -> watch::Receiver<Stages> {
        watch::channel(Stages::default()).1
    }
    /// Returns a watch on the loading states of its component containers; empty if there is nothing to load.
    fn loads(&self) -> watch::Receiver<Loads> {
        watch::channel(Loads::default()).1
    }
    /// Returns what the robot's stubs have set up.
    async fn stub_setup(&self) -> Result<StubSetup, Error> {
        Ok(StubSetup::default())
    }
    /// Sets up what the stubs of a robot have set up in another servant.
    async fn apply_stub_setup(&self, _setup: &StubSetup) -> Result<(), Error> {
        Ok(())
    }
    /// Returns the counts of messages and calls by user.
    fn flows(&self) -> Vec<FlowCounts> {
        Vec::new()
    }
    /// Warns the user of this [`FlowCounts`] of a problem.
    fn warn_flow(&self, _flow: &str, _what: &str) {}
    /// Returns the sizes of messages and requests from its robot, by topic or service.
    fn inputs(&self) -> Vec<(String, SizeSummary)> {
        Vec::new()
    }
    /// Returns the metrics of its rosbridge sessions.
    fn metrics(&self) -> MetricsSnapshot {
        MetricsSnapshot::default()
    }
    /// Replays material and reports the responses and their times.
    async fn replay(
        &self,
        service: &str,
        interface: &Interface,
        material: &Material,
        pace: &ReplayPace,
    ) -> Result<Replay, Error>;
    /// Assigns the servant to a tenant.
    fn bind_tenant(&self, tenant: Weak<dyn Tenant>);
    /// Ends all rosbridge sessions and refuses new ones with this reason.
    fn close_sessions(&self, reason: &str);
    /// Ends all sessions and links and refuses new ones with this reason.
    fn close(&self, reason: &str);
}

/// Opens the reach of servants, wherever their engine has started them.
#[async_trait]
pub trait Opener: Send + Sync + 'static {
    /// Connects to the ROS graph of a running servant and creates a bridge. `recorded` is awaited concurrently.
    async fn open(
        &self,
        servant: &Arc<dyn ServantHandle>,
        recorded: BoxFuture<'_, RecordedRevision>,
        options: ReachOptions,
        observer: Arc<dyn Observer>,
    ) -> Result<Arc<dyn Reach>, Error>;
    /// Connects to the ROS graph of a running servant as the node `name`, to observe its nodes.
    async fn observe(
        &self,
        servant: &Arc<dyn ServantHandle>,
        ros: RosVersion,
        name: &str,
        egress: &[String],
    ) -> Result<ObservedBus, Error>;
    /// Returns the pids of a servant's processes in the host's pid namespace; empty if it runs elsewhere.
    fn process_ids(&self, servant: &str) -> Vec<i32>;
}

/// The bus of an observed servant.
pub struct ObservedBus {
    /// Bus of the servant.
    pub bus: Arc<dyn Bus>,
    /// Guard; egress of the nodes is relayed as long as it lives.
    pub held: Box<dyn Send + Sync>,
}

/// Errors of reaching or trying a servant.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The ROS graph does not respond.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The servant does not belong to this engine.
    #[error("servant {0} does not run here")]
    Elsewhere(String),
    /// A stub's node cannot be started.
    #[error(transparent)]
    Linked(Box<NodeError>),
    /// The material of a trial does not fit.
    #[error("{0}")]
    Trial(String),
}
