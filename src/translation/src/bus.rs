//! The bus of a servant in the terms of the other ROS: a robot of ROS 1 uses a servant of ROS 2 as if it were one of
//! ROS 1, and the reverse.
//!
//! ```text
//!  robot's ROS              TranslatedBus                 servant's ROS
//!  twins of types ── graph, messages, calls, loans ── types of its nodes
//! ```
//! What has no twin is left out of the graph, and [`TranslatedBus::left_out`] says why. A message that cannot be
//! carried is dropped and counted; the [`TranslationObserver`] is told of the first one of each topic. A service that
//! fails in ROS 1 answers a caller of ROS 2, where calls cannot fail, with the default response. Of an action only
//! goals, feedback and results are carried, and its topics or services are made anew, whichever side serves it.

mod actions;
mod graph;
mod lending;
mod losses;
#[cfg(test)]
#[path = "../../../tests/support/memory_bus.rs"]
mod memory_bus;
pub mod parameters;
mod services;
mod state;
#[cfg(test)]
mod tests;
mod topics;
mod twins;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use budget::Budget;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{
    ActionClient, ActionHandler, ActionServer, Bus, BusError, Digest, GlobalParameters, Graph, Lender, Lending,
    LentService, NodeParameters, Offer, ParameterKind, PeerId, Publisher, PublisherReports, QosProfile, RosVersion,
    ServiceHandler, ServiceType, Subscription, WireType,
};
use ros::schema::{ActionDef, MessageType, Registry, ServiceDef};
use tokio::sync::watch;
use tokio_util::task::AbortOnDropHandle;
use tracing::Instrument;

use crate::TypeTranslations;

use actions::ActionEnds;
use lending::TranslatedLending;
use losses::LossCounters;
pub use losses::{TranslationLosses, TranslationObserver};
use parameters::{TranslatedLaunch, TranslatedParameters};
use state::Translation;
use state::not_translated;
pub use state::{LeftOut, LeftOutEntry};
use twins::KnownTwins;

/// A servant's bus as seen by robots of the other ROS version.
pub struct TranslatedBus {
    translation: Arc<Translation>,
    graph: watch::Receiver<Arc<Graph>>,
    left_out: watch::Receiver<Arc<LeftOut>>,
    actions: ActionEnds,
    lending: TranslatedLending,
    /// Keeps the graph up to date.
    _following: AbortOnDropHandle<()>,
}

impl TranslatedBus {
    /// Creates the bus that robots of the other ROS see in place of `inner`. `registry` has the definitions of the
    /// servant's image; goals under way, results and parameters that are kept for robots are charged to `budget`,
    /// as is the processor time for following the graph. Call it within a Tokio runtime.
    pub fn new(
        inner: Arc<dyn Bus>,
        types: Arc<TypeTranslations>,
        registry: Arc<Registry>,
        observer: Arc<dyn TranslationObserver>,
        budget: &Budget,
    ) -> Arc<Self> {
        let version = inner.version().other();
        let translation = Arc::new(Translation {
            parameters: TranslatedParameters::new(&inner, budget.clone()),
            inner,
            version,
            twins: KnownTwins::new(registry, types, version),
            losses: LossCounters::new(observer),
            called: Mutex::default(),
        });
        let (graph, left_out) = (watch::Sender::default(), watch::Sender::default());
        let (graphs, omissions) = (graph.subscribe(), left_out.subscribe());
        let following = graph::follow(Arc::clone(&translation), graph, left_out);
        let following = AbortOnDropHandle::new(tokio::spawn(budget.meter(following).in_current_span()));
        let actions = ActionEnds::new(&translation, budget);
        let lending = TranslatedLending(Arc::clone(&translation));
        Arc::new(Self { translation, graph: graphs, left_out: omissions, actions, lending, _following: following })
    }

    /// Returns what the robot does not see because it cannot be carried, with the reasons, updated as it changes.
    pub fn left_out(&self) -> watch::Receiver<Arc<LeftOut>> {
        self.left_out.clone()
    }

    /// Returns the numbers of messages that were not carried and of values that were replaced, by topic and service.
    pub fn losses(&self) -> Vec<TranslationLosses> {
        self.translation.losses.all()
    }

    /// Returns the definition of a message type that the robot sees, by name and digest (which may be `*`).
    pub fn message(&self, of: &WireType) -> Option<Arc<MessageType>> {
        let (twins, parameters) = (&self.translation.twins, &self.translation.parameters);
        match twins.message_with_twin(of) {
            Some(twin) => Some(Arc::clone(&twin.twin)),
            None => twins.message_of_action(of).or_else(|| parameters.find_message(of)),
        }
    }

    /// Returns the definition of a service type that the robot sees.
    pub fn service(&self, of: &ServiceType) -> Option<Arc<ServiceDef>> {
        match self.translation.twins.service_with_twin(of) {
            Some(twin) => Some(Arc::clone(&twin.twin)),
            None => self.translation.twins.service_of_action(of),
        }
    }

    /// Returns why messages of the servant's type of this name cannot be carried; `None` if they can.
    pub fn message_problem(&self, type_name: &str) -> Option<String> {
        let of = WireType::with_name(type_name).with_version(self.translation.servant_version());
        let twin = self.translation.twins.message(&of);
        twin.err().map(|reason| reason.to_string())
    }

    /// Returns why calls of the servant's service type of this name cannot be carried; `None` if they can.
    pub fn service_problem(&self, type_name: &str) -> Option<String> {
        let of = ServiceType::new(type_name, Digest::any()).with_version(self.translation.servant_version());
        let twin = self.translation.twins.service(&of);
        twin.err().map(|reason| reason.to_string())
    }

    /// Returns why goals of the servant's action type of this name cannot be carried; `None` if they can.
    pub fn action_problem(&self, type_name: &str) -> Option<String> {
        let twin = self.translation.twins.action(type_name);
        twin.err().map(|reason| reason.to_string())
    }

    /// Returns what the robot's node of this absolute name is started with: its arguments, which are in the spelling of
    /// the servant's ROS, and its parameters. `kinds`: types of the node's parameters, as far as they are known.
    pub fn prepare_launch(
        &self,
        node: &str,
        argv: &[String],
        kinds: &BTreeMap<String, ParameterKind>,
    ) -> TranslatedLaunch {
        self.translation.parameters.prepare_launch(node, argv, kinds)
    }

    /// Lets nodes of the servant use the actions of a robot of ROS 2, whose services `lender` finds in the terms of
    /// that ROS. Those of a robot of ROS 1 consist of topics.
    pub fn lend_actions(&self, lender: Arc<dyn Lender>) {
        self.actions.lent_actions().set_lender(lender);
    }

    /// Returns a service of the robot as the servant's nodes see it.
    pub fn lend_to_servant(&self, service: &str, lent: LentService) -> Result<LentService, BusError> {
        lending::lend_to_servant(&self.translation, service, lent)
    }
}

/// Reports of nodes of ROS 1; those of ROS 2 need none.
#[async_trait]
impl PublisherReports for TranslatedBus {
    async fn reported_connections(&self, topic: &str) -> Result<BTreeSet<PeerId>, BusError> {
        let is_made_here =
            self.actions.find_topic(topic)?.is_some() || self.translation.parameters.find_topic(topic).is_some();
        match self.translation.inner.publisher_reports() {
            Some(reports) if !is_made_here => reports.reported_connections(topic).await,
            _ => Err(BusError::NotOffered("reports about topics that no node of the servant publishes")),
        }
    }
}

#[async_trait]
impl Bus for TranslatedBus {
    fn version(&self) -> RosVersion {
        self.translation.version
    }

    async fn distribution(&self) -> String {
        self.translation.inner.distribution().await
    }

    fn node(&self) -> &str {
        self.translation.inner.node()
    }

    fn graph(&self) -> watch::Receiver<Arc<Graph>> {
        self.graph.clone()
    }

    async fn subscribe(&self, topic: &str, of: WireType, qos: QosProfile) -> Result<Subscription, BusError> {
        if let Some((end, action)) = self.actions.lent_actions().find_topic(topic, true) {
            return action.subscribe(end, &of, qos);
        }
        if let Some((end, action)) = self.actions.find_topic(topic)? {
            return action.subscribe((end, topic), &of, qos);
        }
        let parameters = &self.translation.parameters;
        match parameters.find_topic(topic) {
            Some(topic) => parameters.subscribe(topic, &of, qos),
            None => topics::subscribe(&self.translation, topic, of, qos).await,
        }
    }

    async fn advertise(&self, topic: &str, of: WireType, qos: QosProfile) -> Result<Box<dyn Publisher>, BusError> {
        if let Some((end, action)) = self.actions.lent_actions().find_topic(topic, false) {
            return action.advertise(end, &of);
        }
        match self.actions.find_topic(topic)? {
            Some((end, action)) => action.advertise((end, topic), &of),
            None => topics::advertise(&self.translation, topic, &of, qos).await,
        }
    }

    async fn call_typed(
        &self,
        service: &str,
        digest: &Digest,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, BusError> {
        if let Some((end, action)) = self.actions.find_service(service)? {
            return action.call((end, service), digest, request, timeout).await;
        }
        let parameters = &self.translation.parameters;
        if let Some(of) = parameters.find_service_type(service) {
            let ours = of?;
            if !ours.digest.is_compatible_with(digest) {
                let theirs = format!("{} {}", ours.name, ours.digest);
                let what = format!("service {service}");
                return Err(BusError::TypeMismatch { what, theirs, ours: digest.to_string() });
            }
            let report = |text: &str| self.translation.losses.report_refusal(service, text);
            let answer = tokio::time::timeout(timeout, parameters.call(service, &request, &report)).await;
            return answer
                .unwrap_or_else(|_| Err(BusError::Timeout { what: format!("service {service}"), after: timeout }));
        }
        services::call(&self.translation, service, digest, request, timeout).await
    }

    async fn service_type(&self, service: &str) -> Result<ServiceType, BusError> {
        if let Some((end, action)) = self.actions.find_service(service)? {
            return action.service_type(end, service);
        }
        if let Some(of) = self.translation.parameters.find_service_type(service) {
            return of;
        }
        let of = self.translation.inner.service_type(service).await?;
        let twin = self.translation.twins.service(&of);
        let twin = twin.map_err(|reason| not_translated(format!("service {service}"), reason))?;
        Ok(ServiceType::from_service(&twin.twin))
    }

    async fn topic_type(&self, topic: &str) -> Result<WireType, BusError> {
        let offer = self.topic_offer(topic).await?;
        Ok(WireType::clone(&offer.wire_type))
    }

    async fn topic_offer(&self, topic: &str) -> Result<Offer, BusError> {
        if let Some((end, action)) = self.actions.find_topic(topic)? {
            return action.offer(end, topic);
        }
        if let Some(topic) = self.translation.parameters.find_topic(topic) {
            return topic.offer();
        }
        let Offer { wire_type, latching, kept } = self.translation.inner.topic_offer(topic).await?;
        let twin = self.translation.twins.message(&wire_type);
        let twin = twin.map_err(|reason| not_translated(format!("topic {topic}"), reason))?;
        Ok(Offer { wire_type: Arc::new(WireType::from_message(&twin.twin)), latching, kept })
    }

    async fn serve(
        &self,
        service: &str,
        service_type: ServiceType,
        handler: Arc<dyn ServiceHandler>,
    ) -> Result<Box<dyn Send + Sync>, BusError> {
        services::serve(&self.translation, service, &service_type, handler).await
    }

    fn action_client(&self, action: &str, of: &Arc<ActionDef>) -> Result<Box<dyn ActionClient>, BusError> {
        self.actions.client(action, of)
    }

    fn serve_action(
        &self,
        action: &str,
        of: &Arc<ActionDef>,
        handler: Arc<dyn ActionHandler>,
    ) -> Result<Box<dyn ActionServer>, BusError> {
        self.actions.serve(action, of, handler)
    }

    fn parameters(&self) -> Result<&dyn GlobalParameters, BusError> {
        self.translation.parameters.global()
    }

    fn node_parameters(&self) -> Result<&dyn NodeParameters, BusError> {
        self.translation.parameters.of_nodes()
    }

    fn lending(&self) -> Result<&dyn Lending, BusError> {
        self.translation.inner.lending()?;
        Ok(&self.lending)
    }

    fn publisher_reports(&self) -> Option<&dyn PublisherReports> {
        self.translation.inner.publisher_reports().map(|_| self as _)
    }

    fn shutdown_requested(&self) -> Option<watch::Receiver<Option<String>>> {
        self.translation.inner.shutdown_requested()
    }

    fn on_process_exit(&self) {
        self.translation.inner.on_process_exit();
    }

    async fn close(&self) {
        self.actions.cancel_all();
        self.translation.inner.close().await;
    }
}
