//! What a running servant is to a robot: its ROS graph, the rosbridge sessions and the links that use it, nodes that
//! stubs start and end, ways out, and when its interface is there.
//!
//! ```text
//!  container's namespace ─▶ sockets ─▶ Bus ─┬─▶ Bridge ◀─ rosbridge clients
//!                                           └─▶ Hub    ◀─ stubs' links ─▶ LinkedNodes ─▶ container
//!  hosts outside ◀─ relays ◀─ loopback addresses inside
//! ```
//!
//! It knows one servant at a time, and of the rest of the daemon what [`Observer`] and [`Tenant`] show.

#![forbid(unsafe_code)]

pub mod egress;
mod ends;
pub mod links;
pub mod master;
mod nodes;
pub mod readiness;
mod request_times;
mod sockets;

use std::collections::BTreeMap;
use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use bridge::{Bridge, BridgeOptions};
use budget::Budget;
use link::control::Request;
use package::inventory::Inventory;
use ros::JoinOptions;
use ros::bus::{Bus, BusError, ParamValue, RosVersion};
use ros::flavour::Flavour;
use ros::schema::Registry;
use servant::spec::NodeSpec;

use egress::{Relays, Way};
use links::{Hub, HubOptions};

pub use ends::how_it_ended;
pub use nodes::{LinkedNodes, has_none_of};
pub use request_times::RequestTimes;
pub use sockets::ServantSockets;

/// The name of our node in every servant's graph.
const NODE: &str = "/cloudroid_bridge";

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
    /// What the image holds.
    pub inventory: Arc<Inventory>,
    /// Message definitions.
    pub registry: Arc<Registry>,
    /// Hosts that its nodes may connect to.
    pub ways_out: Vec<Way>,
}

/// The daemon, as one servant's reach sees it.
pub trait Observer: Send + Sync + 'static {
    /// Whether a stub that was made of the revision of this number, with this image, can use the servant; else why not.
    fn fits(&self, made_of: Option<u64>, image: &str) -> Result<(), String>;
    /// Something that the operator should know of the servant and its robot.
    fn event(&self, level: api::Level, kind: &str, message: &str, robot: Option<&str>);
    /// The time of a request, and its parts, have become known.
    fn measured(&self, request: &Request);
}

/// Whom a servant serves: nobody while it is a spare.
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
    /// Sessions of rosbridge.
    pub bridge: BridgeOptions,
    /// How long a link outlives its connection.
    pub grace: Duration,
    /// Memory held for the servant's nodes, links and clients.
    pub budget: Budget,
    /// Time from the first byte of a message or frame to its last.
    pub unfinished: Duration,
}

/// ROS, sessions, links and ways out of one servant.
pub struct Reach {
    /// Its ROS.
    pub bus: Arc<dyn Bus>,
    /// Before it, for rosbridge's clients.
    pub bridge: Arc<Bridge>,
    /// Before it, for the robot's stubs.
    pub hub: Arc<Hub>,
    /// What those have started.
    pub nodes: Arc<LinkedNodes>,
    _relays: Relays,
}

impl Reach {
    /// Connects to the Master of a running container and sets a bridge before it. `recorded` is awaited meanwhile.
    pub async fn open(
        container: &Arc<dyn servant::engine::Servant>,
        recorded: impl Future<Output = Recorded>,
        options: ReachOptions,
        observer: Arc<dyn Observer>,
    ) -> Result<Arc<Reach>, BusError> {
        let sockets = Arc::new(ServantSockets::new(&container.endpoint()));
        let joining = JoinOptions {
            budget: options.budget.clone(),
            unfinished: options.unfinished,
            ..JoinOptions::new(master::ADDRESS, NODE)
        };
        let joined = ros::connect(options.ros, sockets, joining);
        let (bus, recorded) = tokio::join!(joined, recorded);
        let bus = bus?;
        let registry = Arc::clone(&recorded.registry);
        let relays = Relays::open(&container.endpoint(), &recorded.ways_out).await;
        let nodes = Arc::new(LinkedNodes::new(recorded, container, observer));
        let hub = Hub::new(
            container.id(),
            Arc::clone(&bus),
            Arc::clone(&registry),
            Arc::clone(&nodes) as Arc<dyn links::Nodes>,
            HubOptions {
                grace: options.grace,
                budget: options.budget.clone(),
                unfinished: options.unfinished,
                ..HubOptions::default()
            },
        );
        let options = BridgeOptions {
            budget: options.budget,
            ..options.bridge
        };
        let bridge = Bridge::new(Arc::clone(&bus), registry, options);
        Ok(Arc::new(Reach {
            bus,
            bridge,
            hub,
            nodes,
            _relays: relays,
        }))
    }

    /// Messages dropped because a client or the bridge was slow.
    pub fn dropped(&self) -> u64 {
        let metrics = self.bridge.metrics();
        metrics.dropped.get() + metrics.bus_dropped.get()
    }
}
