//! [`Bus`] over ROS 2: one DDS participant, a node with its own name, that publishes, subscribes, calls and serves on
//! behalf of the owner of the bus.
//!
//! ```text
//!   DDS discovery ───────────┬─▶ watcher ─▶ DiscoverySnapshot ─▶ graph, and all that track it
//!   ros_discovery_info ──────┘
//!   subscribe ─▶ TopicIn ─▶ one reader per quality offered by publishers ─▶ all local queues
//!   advertise ─▶ one writer each;  its matched readers are its subscribers
//!   call ─▶ ServiceClient: writer of requests, reader of replies, kept for the next call
//!   serve ─▶ reader of requests ─▶ handler ─▶ writer of replies
//! ```
//! This node's endpoints are announced to the others in `ros_discovery_info`, which attributes endpoints to nodes.
//!
//! Sinks are called while the participant's lock is not held. Readers and writers are created and dropped only while no
//! lock is held that a sink takes, because doing so takes the participant's lock.
//!
//! Actions use the same parts: `calls::client_for` and `services::serve` with names below `/_action/`, and `raw`, whose
//! endpoints hear each other, because an action's client may have its server behind the same bus.

use std::collections::BTreeMap;
use std::fmt;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use ros_bus::net::Sockets;
use ros_bus::{
    ActionClient, ActionHandler, ActionServer, Bus, BusError, Digest, Graph, JoinOptions, Lending, NodeNames,
    NodeParameters, Publisher, QosProfile, RosVersion, ServiceHandler, ServiceType, Subscription, WireFormat, WireType,
};
use ros_message::schema::ActionDef;
use rtps::{Config, GuidPrefix, JoinError, Participant};
use tokio::runtime::Handle;
use tokio::sync::watch;
use tokio::time::timeout;
use tracing::Span;

use super::ends::LocalEndpointTable;
use super::entities::{self, GidSize, ParticipantTable};
use super::place::{self, BusSockets};
use super::raw::Hub;
use super::state::{Clients, Loans, RetiredServices, Ros2BusState, TopicMap};
use super::watcher::Watcher;
use super::{actions, calls, names, publications, services, subscriptions, topic_type};

/// User data of our participant: the security enclave, as ROS 2 participants announce it.
const USER_DATA: &[u8] = b"enclave=/;";
/// Time for queued data when the bus closes.
const FAREWELL: Duration = Duration::from_secs(2);

/// A ROS 2 system as a [`Bus`]. Dropping it ends all activity, as [`Bus::close`] does, without waiting.
pub struct Ros2Bus {
    pub(super) inner: Arc<Ros2BusState>,
}

impl Ros2Bus {
    /// Joins the ROS 2 system of a domain.
    pub async fn connect(sockets: Arc<dyn Sockets>, options: JoinOptions) -> Result<Arc<Self>, BusError> {
        if !names::is_global(&options.node) {
            return Err(BusError::BadName(options.node));
        }
        let prefix = GuidPrefix::random();
        let predecessors = match &options.succession {
            Some(succession) => succession.record_join(&options.node, prefix.0).await,
            None => Vec::new(),
        };
        let config = Config {
            user_data: Bytes::from_static(USER_DATA),
            max_sample: options.max_message,
            budget: options.budget.clone(),
            unfinished: options.unfinished,
            prefix: Some(prefix),
            predecessors: predecessors.into_iter().map(GuidPrefix).collect(),
            ..Config::new(options.domain, options.node.clone())
        };
        let config = place::with_network(config, options.network);
        let joined = Participant::join(Arc::new(BusSockets(sockets)), config).await;
        let participant = joined.map_err(join_error)?;
        let told = Arc::new(ParticipantTable::default());
        let listening = participant.reader(entities::topic(), entities::qos(), Arc::clone(&told) as _);
        let teller = participant.writer(entities::topic(), entities::qos());
        let inner = Arc::new(Ros2BusState {
            participant,
            node: options.node,
            distribution: options.distribution,
            told,
            own: LocalEndpointTable::default(),
            seen: watch::Sender::default(),
            graph: watch::Sender::default(),
            hub: Hub::default(),
            subscriptions: TopicMap::default(),
            adverts: Mutex::default(),
            clients: Clients::default(),
            services: Mutex::default(),
            loans: Loans::default(),
            retired: RetiredServices::default(),
            served: watch::Sender::default(),
            listening: Mutex::new(Some(listening)),
            closed: AtomicBool::new(false),
            runtime: Handle::current(),
            log_span: Span::current(),
            tasks: Mutex::default(),
        });
        let mut watcher = Watcher::new(Arc::clone(&inner), teller);
        watcher.refresh();
        inner.spawn(options.budget.meter(watcher.run()));
        Ok(Arc::new(Self { inner }))
    }

    /// Returns the GUID of this node's participant.
    pub fn guid(&self) -> rtps::Guid {
        self.inner.participant.guid()
    }
}

fn join_error(error: JoinError) -> BusError {
    let what = "joining ROS 2".to_owned();
    match error {
        JoinError::Socket(source) => BusError::Io { what, source },
        other => BusError::Io { what, source: io::Error::other(other) },
    }
}

impl Drop for Ros2Bus {
    fn drop(&mut self) {
        self.inner.shut_down();
        let participant = self.inner.participant.clone();
        self.inner.runtime.spawn(async move { participant.close().await });
    }
}

impl fmt::Debug for Ros2Bus {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("Ros2Bus")
            .field("node", &self.inner.node)
            .field("guid", &self.guid())
            .finish_non_exhaustive()
    }
}

/// Converts to a type with its name in ROS 2, in ROS 2's format if its definition is unknown.
fn to_ros2_type(of: WireType) -> WireType {
    WireType {
        name: names::full_type_name(&of.name, "msg"),
        format: if of.digest.is_any() { WireFormat::Cdr } else { of.format },
        ..of
    }
}

#[async_trait]
impl Bus for Ros2Bus {
    fn version(&self) -> RosVersion {
        RosVersion::Two
    }

    /// Returns the distribution given when joining, or else a guess from what is discovered: DDS does not announce it.
    async fn distribution(&self) -> String {
        if !self.inner.distribution.is_empty() {
            return self.inner.distribution.clone();
        }
        match self.inner.seen.borrow().gids {
            GidSize::Sixteen => "jazzy".to_owned(),
            GidSize::TwentyFour => "humble".to_owned(),
        }
    }

    fn node(&self) -> &str {
        &self.inner.node
    }

    fn set_represented_nodes(&self, nodes: BTreeMap<String, NodeNames>) {
        self.inner.own.set_represented_nodes(nodes);
    }

    fn graph(&self) -> watch::Receiver<Arc<Graph>> {
        self.inner.graph.subscribe()
    }

    async fn subscribe(&self, topic: &str, of: WireType, qos: QosProfile) -> Result<Subscription, BusError> {
        self.inner.check_name(topic)?;
        subscriptions::subscribe(&self.inner, topic, to_ros2_type(of), qos)
    }

    async fn advertise(&self, topic: &str, of: WireType, qos: QosProfile) -> Result<Box<dyn Publisher>, BusError> {
        self.inner.check_name(topic)?;
        publications::advertise(&self.inner, topic, to_ros2_type(of), qos).await
    }

    async fn call_typed(
        &self,
        service: &str,
        digest: &Digest,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, BusError> {
        self.inner.check_name(service)?;
        calls::call(&self.inner, service, digest, request, timeout).await
    }

    async fn service_type(&self, service: &str) -> Result<ServiceType, BusError> {
        self.inner.check_name(service)?;
        calls::find_type(&self.inner, service, calls::GRACE).await
    }

    async fn topic_type(&self, topic: &str) -> Result<WireType, BusError> {
        self.inner.check_name(topic)?;
        topic_type::find(&self.inner, topic).await
    }

    async fn serve(
        &self,
        service: &str,
        service_type: ServiceType,
        handler: Arc<dyn ServiceHandler>,
    ) -> Result<Box<dyn Send + Sync>, BusError> {
        self.inner.check_name(service)?;
        let of = ServiceType {
            name: names::full_type_name(&service_type.name, "srv"),
            format: WireFormat::Cdr,
            ..service_type
        };
        services::serve(&self.inner, service, of, handler)
    }

    fn action_client(&self, action: &str, of: &Arc<ActionDef>) -> Result<Box<dyn ActionClient>, BusError> {
        self.inner.check_name(action)?;
        Ok(Box::new(actions::Ros2ActionClient::open(&self.inner, action, of)?))
    }

    fn serve_action(
        &self,
        action: &str,
        of: &Arc<ActionDef>,
        handler: Arc<dyn ActionHandler>,
    ) -> Result<Box<dyn ActionServer>, BusError> {
        self.inner.check_name(action)?;
        let server = actions::Ros2ActionServer::open(&self.inner, action, of, handler)?;
        Ok(Box::new(server))
    }

    fn node_parameters(&self) -> Result<&dyn NodeParameters, BusError> {
        Ok(self)
    }

    fn lending(&self) -> Result<&dyn Lending, BusError> {
        Ok(self)
    }

    fn on_process_exit(&self) {
        self.inner.participant.check_ports();
    }

    async fn close(&self) {
        if self.inner.closed.swap(true, Ordering::AcqRel) {
            return;
        }
        // Data published or answers given until now are still to be sent.
        let _ = timeout(FAREWELL, self.inner.participant.wait_acknowledged()).await;
        self.inner.shut_down();
        self.inner.participant.close().await;
    }
}
