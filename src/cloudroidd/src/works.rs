//! What makes a container useful to a robot: its ROS, reached from outside, and the bridge before it.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;

use bridge::{Bridge, BridgeOptions};
use link::cloud::{Hub, HubOptions};
use ros::bus::{Bus, BusError};
use ros::ros1::{Ros1Bus, Ros1Options};

use crate::choreographer::Inner;
use crate::config::{Config, NonFinite};
use crate::grants::Relays;
use crate::linked::LinkedNodes;
use crate::sockets::ServantSockets;
use store::RevisionRecord;

/// Where every servant's ROS Master listens, as seen from inside.
pub const MASTER: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), 11311);
/// The name of our node in every servant's graph.
const NODE: &str = "/cloudroid_bridge";

/// ROS and bridge of one servant.
pub struct Works {
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

impl Works {
    /// Connects to the Master of a running container and sets a bridge before it.
    pub async fn reach(
        inner: &Inner,
        revision: &RevisionRecord,
        container: &Arc<dyn servant::engine::Servant>,
    ) -> Result<Arc<Works>, BusError> {
        let sockets = Arc::new(ServantSockets::new(&container.endpoint()));
        let budget = inner.memory.servant(container.id());
        let unfinished = inner.memory.unfinished;
        let joining = Ros1Options {
            budget: budget.clone(),
            unfinished,
            ..Ros1Options::new(MASTER, NODE)
        };
        let (bus, registry) = tokio::join!(
            Ros1Bus::connect_with(sockets, joining),
            inner.catalogue.registry(revision),
        );
        let bus: Arc<dyn Bus> = bus?;
        let nodes = Arc::new(LinkedNodes::new(inner, revision, container).await);
        let options = HubOptions {
            grace: inner.config.servant.grace.0,
            budget: budget.clone(),
            unfinished,
            ..HubOptions::default()
        };
        let hub = Hub::new(
            container.id(),
            Arc::clone(&bus),
            Arc::clone(&registry),
            Arc::clone(&nodes) as Arc<dyn link::cloud::Nodes>,
            options,
        );
        let relays = Relays::open(
            &container.endpoint(),
            &revision.plan.grants,
            &inner.config.allow,
        )
        .await;
        let options = BridgeOptions {
            budget,
            ..bridge_options(&inner.config)
        };
        let bridge = Bridge::new(Arc::clone(&bus), registry, options);
        Ok(Arc::new(Works {
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

/// What the configuration says of bridges.
pub fn bridge_options(config: &Config) -> BridgeOptions {
    let bytes = |size: api::Size| usize::try_from(size.0).unwrap_or(usize::MAX);
    BridgeOptions {
        max_frame: bytes(config.portal.max_frame),
        max_message: bytes(config.portal.max_message),
        max_encoded: bytes(config.portal.max_encoded),
        unfinished: config.memory.unfinished.0,
        ping_interval: config.portal.ping.0,
        idle_timeout: config.portal.idle.0,
        non_finite: match config.portal.non_finite {
            NonFinite::Null => ros::codec::NonFinite::Null,
            NonFinite::Text => ros::codec::NonFinite::String,
            NonFinite::Bare => ros::codec::NonFinite::Bare,
        },
        resume_grace: config.servant.grace.0,
        ..BridgeOptions::default()
    }
}
