//! A servant, or a robot's place in a group, that is reached in this process.

use std::any::Any;
use std::sync::{Arc, Weak};

use async_trait::async_trait;
use bridge::{Bridge, BridgeOptions, Metrics, SessionEnd, SessionOptions, Waiting};
use link::control::Node;
use link::session::Lost;
use package::interface::Interface;
use ros::bus::{Bus, Graph};
use ros::schema::Registry;
use ros::sizes::Seen;
use tokio::sync::watch;

use crate::components::{Components, Loads};
use crate::inside::{Inside, Joining, Looked};
use crate::lifecycle::{Lifecycles, Stages};
use crate::links::{Hub, HubOptions, LinkStatus, Nodes};
use crate::tap::Tap;
use crate::trial::{self, Material, Pace, Replay};
use crate::{Error, Flow, Linked, Reach, ReachOptions, Stream, Tenant};

/// A bus, the bridge before it, and the hub of its links.
pub(crate) struct InProcess {
    bus: Arc<dyn Bus>,
    tap: Arc<Tap>,
    bridge: Arc<Bridge>,
    inside: Inside,
    hub: Arc<Hub>,
    /// What the robot's stubs have started.
    nodes: Arc<dyn Nodes>,
    lifecycles: Option<Lifecycles>,
    components: Option<Components>,
    /// What must be there while this is.
    _keeps: Box<dyn Any + Send + Sync>,
}

/// What clients and links are set before.
pub(crate) struct Behind {
    /// The id of the servant, or of the robot's place.
    pub(crate) id: String,
    /// The bus that rosbridge clients see.
    pub(crate) bus: Arc<dyn Bus>,
    /// The bus that stubs see, with the nodes that they start and end.
    pub(crate) linked: (Arc<dyn Bus>, Arc<dyn Nodes>),
    /// The bus of those who look into it.
    pub(crate) inside: Joining,
    pub(crate) registry: Arc<Registry>,
    pub(crate) lifecycles: Option<Lifecycles>,
    pub(crate) components: Option<Components>,
    pub(crate) keeps: Box<dyn Any + Send + Sync>,
}

impl InProcess {
    pub(crate) fn new(behind: Behind, options: ReachOptions) -> InProcess {
        let Behind {
            id,
            bus,
            linked: (linked, nodes),
            inside,
            registry,
            lifecycles,
            components,
            keeps,
        } = behind;
        let tap = Arc::new(Tap::default());
        let shown = tap.before(Arc::clone(&bus));
        // Stubs of a robot that shares its servants see these by names of their own.
        let linked = match std::ptr::addr_eq(Arc::as_ptr(&bus), Arc::as_ptr(&linked)) {
            true => Arc::clone(&shown),
            false => linked,
        };
        let bus = shown;
        let habits = HubOptions {
            grace: options.grace,
            budget: options.budget.clone(),
            unfinished: options.unfinished,
            ..HubOptions::default()
        };
        let hub = Hub::new(
            &id,
            linked,
            Arc::clone(&registry),
            Arc::clone(&nodes),
            habits,
        );
        let options = BridgeOptions {
            budget: options.budget,
            ..options.bridge
        };
        InProcess {
            inside: Inside::new(inside, Arc::clone(&registry), &options),
            bridge: Bridge::new(Arc::clone(&bus), registry, options),
            bus,
            tap,
            hub,
            nodes,
            lifecycles,
            components,
            _keeps: keeps,
        }
    }
}

#[async_trait]
impl Reach for InProcess {
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

    async fn serve_inside(&self, client: Waiting<Stream>, options: SessionOptions) -> SessionEnd {
        self.inside.serve(client, options).await
    }

    async fn look_inside(&self) -> Result<Looked, (u16, String)> {
        self.inside.look().await
    }

    async fn serve_link(&self, stream: Stream, read_ahead: &[u8]) -> Lost {
        self.hub.serve(stream, read_ahead).await
    }

    fn tap(&self) -> Option<Arc<Tap>> {
        Some(Arc::clone(&self.tap))
    }

    fn lifecycles(&self) -> Option<watch::Receiver<Stages>> {
        self.lifecycles.as_ref().map(Lifecycles::stages)
    }

    fn loads(&self) -> Option<watch::Receiver<Loads>> {
        self.components.as_ref().map(Components::loads)
    }

    async fn linked(&self) -> Vec<Linked> {
        self.nodes.running().await
    }

    async fn start_linked(&self, node: &Node) -> Result<(), Error> {
        // Where there are none, the node's own are on its command line.
        if let Ok(parameters) = self.bus.parameters() {
            for (key, value) in self.nodes.parameters(node) {
                parameters.set(&key, value).await?;
            }
        }
        self.nodes.start(node, "").await.map_err(Error::Linked)
    }

    fn links(&self) -> Vec<LinkStatus> {
        self.hub.status()
    }

    fn flows(&self) -> Vec<Flow> {
        let metrics = self.bridge.metrics();
        // The bridge answers calls that are refused, time out or reach no node, in place of the node.
        let by_bridge = metrics
            .calls_failed
            .get()
            .saturating_sub(metrics.calls_denied.get());
        let answers = metrics.answers.get().saturating_sub(by_bridge);
        let clients = Flow {
            node: String::new(),
            // What nobody listens to the answers of need not be answered.
            inputs: metrics.asked.get() + metrics.calls.get(),
            outputs: metrics.received.get() + answers,
        };
        let mut flows = self.hub.flows();
        flows.push(clients);
        flows
    }

    fn report(&self, flow: &str, what: &str) {
        match flow {
            "" => self.bridge.report(what),
            node => self.hub.warn(node, what),
        }
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
        self.inside.close(reason);
        self.bridge.close(reason);
    }

    fn close(&self, reason: &str) {
        self.hub.close(reason);
        self.inside.close(reason);
        self.bridge.close(reason);
    }
}
