//! A servant, or a robot's place in a group, that is reached in this process.

use std::any::Any;
use std::sync::{Arc, Weak};

use async_trait::async_trait;
use bridge::{Bridge, BridgeOptions, MetricsSnapshot, RequestObserver, SessionEnd, SessionOptions, WaitingConnection};
use budget::Budget;
use futures_util::future::BoxFuture;
use package::interface::Interface;
use ros::bus::{Bus, Graph};
use ros::schema::Registry;
use ros::sizes::SizeSummary;
use tokio::sync::watch;

use crate::components::{ComponentLoader, Loads};
use crate::inside::{InsideHost, InsideView, JoinFn};
use crate::lifecycle::{LifecycleDriver, Stages};
use crate::links::{Hub, HubOptions, LinkStatus, NodeController};
use crate::tap::{Tap, TapReceiver};
use crate::trial::{self, Material, Replay, ReplayPace};
use crate::{Error, FlowCounts, Observer, Reach, ReachOptions, StubSetup, Tenant, UpgradedStream};

/// A bus with a bridge and a link hub.
pub(crate) struct InProcess {
    bus: Arc<dyn Bus>,
    tap: Arc<Tap>,
    bridge: Arc<Bridge>,
    inside: InsideHost,
    hub: Arc<Hub>,
    /// Nodes started by the robot's stubs.
    nodes: Arc<dyn NodeController>,
    lifecycles: Option<LifecycleDriver>,
    components: Option<ComponentLoader>,
    /// Values kept alive by this one.
    _keeps: Box<dyn Any + Send + Sync>,
}

/// The parts of which an [`InProcess`] is made.
pub(crate) struct InProcessParts {
    /// Id of the servant or of the robot's place.
    pub(crate) id: String,
    /// Bus for rosbridge clients.
    pub(crate) bus: Arc<dyn Bus>,
    /// Bus for stubs, and the nodes that they start and stop.
    pub(crate) linked: (Arc<dyn Bus>, Arc<dyn NodeController>),
    /// Joins the bus for people who look inside.
    pub(crate) inside: JoinFn,
    pub(crate) registry: Arc<Registry>,
    pub(crate) observer: Arc<dyn Observer>,
    pub(crate) lifecycles: Option<LifecycleDriver>,
    pub(crate) components: Option<ComponentLoader>,
    pub(crate) keeps: Box<dyn Any + Send + Sync>,
}

impl InProcess {
    pub(crate) fn new(behind: InProcessParts, options: ReachOptions) -> InProcess {
        let InProcessParts { id, bus, linked: (linked, nodes), inside, registry, observer, .. } = behind;
        let tap = Arc::new(Tap::default());
        let shown = tap.wrap(Arc::clone(&bus));
        // Stubs of a robot that shares its servants see them under names of their own.
        let linked =
            if std::ptr::addr_eq(Arc::as_ptr(&bus), Arc::as_ptr(&linked)) { Arc::clone(&shown) } else { linked };
        let bus = shown;
        let habits = HubOptions {
            grace: options.grace,
            budget: options.budget.clone(),
            unfinished: options.unfinished,
            rules: options.rules,
            ..HubOptions::default()
        };
        let hub = Hub::new(&id, linked, Arc::clone(&registry), Arc::clone(&nodes), habits);
        let called = RequestObserver::new(move |took| observer.on_rosbridge_request(took));
        let options = BridgeOptions { budget: options.budget, called, ..options.bridge };
        InProcess {
            inside: InsideHost::new(inside, Arc::clone(&registry), &options),
            bridge: Bridge::new(Arc::clone(&bus), registry, options),
            bus,
            tap,
            hub,
            nodes,
            lifecycles: behind.lifecycles,
            components: behind.components,
            _keeps: behind.keeps,
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

    async fn serve_rosbridge(&self, client: WaitingConnection<UpgradedStream>, options: SessionOptions) -> SessionEnd {
        self.bridge.serve_waiting(client, options).await
    }

    async fn serve_inside(&self, client: WaitingConnection<UpgradedStream>, options: SessionOptions) -> SessionEnd {
        self.inside.serve(client, options).await
    }

    async fn open_inside(&self) -> Result<InsideView, (u16, String)> {
        self.inside.open_view().await
    }

    async fn serve_link(&self, stream: UpgradedStream, read_ahead: &[u8], end: BoxFuture<'_, String>) -> String {
        self.hub.serve_until(stream, read_ahead, end).await.to_string()
    }

    async fn tap(&self, budget: &Budget) -> Option<TapReceiver> {
        self.tap.listen(budget)
    }

    fn lifecycles(&self) -> watch::Receiver<Stages> {
        self.lifecycles.as_ref().map_or_else(|| watch::channel(Stages::default()).1, LifecycleDriver::stages)
    }

    fn loads(&self) -> watch::Receiver<Loads> {
        self.components.as_ref().map_or_else(|| watch::channel(Loads::default()).1, ComponentLoader::loads)
    }

    async fn stub_setup(&self) -> Result<StubSetup, Error> {
        Ok(self.hub.read_setup().await?)
    }

    async fn apply_stub_setup(&self, setup: &StubSetup) -> Result<(), Error> {
        let applied = self.hub.apply_setup(setup).await;
        applied.map_err(|error| Error::Linked(Box::new(error)))
    }

    fn links(&self) -> Vec<LinkStatus> {
        self.hub.status()
    }

    fn flows(&self) -> Vec<FlowCounts> {
        let metrics = self.bridge.metrics();
        // The bridge itself answers calls that are refused, time out or reach no node.
        let by_bridge = metrics.calls_failed.get().saturating_sub(metrics.calls_denied.get());
        let answers = metrics.answers.get().saturating_sub(by_bridge);
        let clients = FlowCounts {
            node: String::new(),
            // Calls whose response nobody waits for need not be answered.
            inputs: metrics.asked.get() + metrics.calls.get(),
            outputs: metrics.received.get() + answers,
        };
        let mut flows = self.hub.flows();
        flows.push(clients);
        flows
    }

    fn warn_flow(&self, flow: &str, what: &str) {
        match flow {
            "" => self.bridge.report(what),
            node => self.hub.warn(node, what),
        }
    }

    fn inputs(&self) -> Vec<(String, SizeSummary)> {
        let mut inputs = self.hub.inputs();
        inputs.extend(self.bridge.inputs());
        inputs
    }

    fn metrics(&self) -> MetricsSnapshot {
        self.bridge.metrics().snapshot()
    }

    async fn replay(
        &self,
        service: &str,
        interface: &Interface,
        material: &Material,
        pace: &ReplayPace,
    ) -> Result<Replay, Error> {
        trial::replay(&self.bus, service, interface, material, pace).await
    }

    fn bind_tenant(&self, tenant: Weak<dyn Tenant>) {
        self.nodes.bind_tenant(tenant);
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
