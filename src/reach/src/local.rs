//! Servants of this host's engine: reached in this process, by sockets in their network namespaces.

use std::sync::{Arc, Weak};

use async_trait::async_trait;
use bridge::{Bridge, BridgeOptions, Metrics, SessionEnd, SessionOptions, Waiting};
use futures_util::future::BoxFuture;
use link::session::Lost;
use package::interface::Interface;
use ros::JoinOptions;
use ros::bus::{Bus, Graph, RosVersion};
use ros::sizes::Seen;
use servant::engine::Servant;
use servant::local::{LocalEngine, LocalServant};
use tokio::sync::watch;

use crate::egress::{self, Relays};
use crate::links::{self, Hub, HubOptions, LinkStatus};
use crate::nodes::LinkedNodes;
use crate::sockets::ServantSockets;
use crate::trial::{self, Material, Pace, Replay};
use crate::{
    Error, Flow, Look, Observer, Opener, Reach, ReachOptions, Recorded, Stream, Tenant, master,
};

/// The name of our node in every servant's graph.
const NODE: &str = "/cloudroid_bridge";

/// Reaches the servants of an engine of this host.
pub struct LocalOpener {
    engine: LocalEngine,
    /// `egress` of what the operator allows.
    egress: Vec<String>,
}

impl LocalOpener {
    /// For the servants of `engine`; their nodes get to those hosts that are granted to them and in `egress`.
    pub fn new(engine: LocalEngine, egress: Vec<String>) -> LocalOpener {
        LocalOpener { engine, egress }
    }

    fn local(&self, servant: &Arc<dyn Servant>) -> Result<Arc<LocalServant>, Error> {
        let id = servant.id();
        let found = self.engine.servant(id);
        found.ok_or_else(|| Error::Elsewhere(id.to_owned()))
    }

    async fn relays(&self, servant: &LocalServant, egress: &[String]) -> Relays {
        // Not allowed any more: then the servant would not have been started either.
        let routes = egress::routes(egress, &self.egress).unwrap_or_default();
        Relays::open(servant.network(), &routes).await
    }
}

#[async_trait]
impl Opener for LocalOpener {
    async fn open(
        &self,
        servant: &Arc<dyn Servant>,
        recorded: BoxFuture<'_, Recorded>,
        options: ReachOptions,
        observer: Arc<dyn Observer>,
    ) -> Result<Arc<dyn Reach>, Error> {
        let local = self.local(servant)?;
        let joining = JoinOptions {
            budget: options.budget.clone(),
            unfinished: options.unfinished,
            ..JoinOptions::new(master::ADDRESS, NODE)
        };
        let sockets = Arc::new(ServantSockets::new(local.network()));
        let joined = ros::connect(options.ros, sockets, joining);
        let (bus, recorded) = tokio::join!(joined, recorded);
        let bus = bus?;
        let registry = Arc::clone(&recorded.registry);
        let relays = self.relays(&local, &recorded.egress).await;
        let nodes = Arc::new(LinkedNodes::new(recorded, servant, observer));
        let hub = Hub::new(
            servant.id(),
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
        Ok(Arc::new(LocalReach {
            bus,
            bridge,
            hub,
            nodes,
            _relays: relays,
        }))
    }

    async fn look(
        &self,
        servant: &Arc<dyn Servant>,
        ros: RosVersion,
        name: &str,
        egress: &[String],
    ) -> Result<Look, Error> {
        let local = self.local(servant)?;
        let relays = self.relays(&local, egress).await;
        let sockets = Arc::new(ServantSockets::new(local.network()));
        let joining = JoinOptions::new(master::ADDRESS, name);
        Ok(Look {
            bus: ros::connect(ros, sockets, joining).await?,
            _relays: relays,
        })
    }

    fn processes(&self, servant: &str) -> Vec<i32> {
        let servant = self.engine.servant(servant);
        servant
            .and_then(|servant| servant.processes().ok())
            .unwrap_or_default()
    }
}

/// ROS, sessions, links and routes out of one servant.
struct LocalReach {
    bus: Arc<dyn Bus>,
    bridge: Arc<Bridge>,
    hub: Arc<Hub>,
    /// What the robot's stubs have started.
    nodes: Arc<LinkedNodes>,
    _relays: Relays,
}

#[async_trait]
impl Reach for LocalReach {
    fn bus(&self) -> Arc<dyn Bus> {
        Arc::clone(&self.bus)
    }

    fn graph(&self) -> watch::Receiver<Arc<Graph>> {
        self.bus.graph()
    }

    async fn serve_rosbridge(
        &self,
        client: Waiting<Stream>,
        options: SessionOptions,
    ) -> SessionEnd {
        self.bridge.serve_waiting(client, options).await
    }

    async fn serve_link(&self, stream: Stream, read_ahead: &[u8]) -> Lost {
        self.hub.serve(stream, read_ahead).await
    }

    fn links(&self) -> Vec<LinkStatus> {
        self.hub.status()
    }

    fn flows(&self) -> Vec<Flow> {
        let metrics = self.bridge.metrics();
        let clients = Flow {
            node: String::new(),
            // What nobody listens to the answers of need not be answered.
            inputs: metrics.asked.get() + metrics.calls.get(),
            outputs: metrics.received.get() + metrics.answers.get(),
        };
        let mut flows = self.hub.flows();
        flows.push(clients);
        flows
    }

    fn inputs(&self) -> Vec<(String, Seen)> {
        let mut inputs = self.hub.inputs();
        inputs.extend(self.bridge.inputs());
        inputs
    }

    fn metrics(&self) -> &Metrics {
        self.bridge.metrics()
    }

    async fn replay(
        &self,
        service: &str,
        interface: &Interface,
        material: &Material,
        pace: &Pace,
    ) -> Result<Replay, Error> {
        trial::replay(&self.bus, service, interface, material, pace).await
    }

    fn bind(&self, tenant: Weak<dyn Tenant>) {
        self.nodes.bind(tenant);
    }

    fn close_sessions(&self, reason: &str) {
        self.bridge.close(reason);
    }

    fn close(&self, reason: &str) {
        self.hub.close(reason);
        self.bridge.close(reason);
    }
}
