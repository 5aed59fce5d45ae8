//! [`Bus`] over ROS 2: one DDS participant, a node with a name of its own, that publishes, subscribes, calls and serves on
//! behalf of whoever holds the bus.
//!
//! ```text
//!   discovered ──────────────┬─▶ watcher ─▶ Seen ─▶ graph, and all that follow it
//!   ros_discovery_info ──────┘
//!   subscribe ─▶ TopicIn ─▶ one reader per quality that publishers offer ─▶ all local queues
//!   advertise ─▶ one writer each;  its matched readers are its subscribers
//!   call ─▶ Client: writer of requests, reader of replies, kept for the next call
//!   serve ─▶ reader of requests ─▶ handler ─▶ writer of replies
//! ```
//! What this node has is told to the others in `ros_discovery_info`, by which they know whose an end is.
//!
//! Sinks are called while nobody holds the participant's lock. Readers and writers are made and dropped while no lock is held
//! that a sink takes, because the participant's is taken for that.
//!
//! Actions are made of the same: `calls::client` and `services::serve` with names below `/_action/`, and `raw`, whose ends hear
//! each other, because an action's client may have its server behind the same bus.

use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::future::Future;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use rtps::{Config, Discovered, GuidPrefix, JoinError, Participant};
use tokio::runtime::Handle;
use tokio::sync::watch;
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::timeout;

use super::actions::Retired;
use super::calls::Clients;
use super::ends::Own;
use super::entities::{self, GidSize, Told};
use super::lending::Loans;
use super::place::Place;
use super::publications::Adverts;
use super::raw::Hub;
use super::seen::Seen;
use super::services::Served;
use super::subscriptions::Topics;
use super::watcher::Watcher;
use super::{actions, calls, names, publications, services, subscriptions, topic_type};
use crate::JoinOptions;
use crate::bus::{
    ActionClient, ActionHandler, ActionServer, Bus, BusError, Digest, Graph, Lending, NodeNames,
    NodeParameters, Publisher, Qos, RosVersion, ServiceHandler, ServiceType, Subscription,
    WireFormat, WireType,
};
use crate::net::Sockets;
use crate::schema::ActionDef;

/// Of ROS 2's participants: which enclave of security they are in.
const USER_DATA: &[u8] = b"enclave=/;";
/// For what is queued when the bus closes.
const FAREWELL: Duration = Duration::from_secs(2);

/// A ROS 2 system as a [`Bus`]. Dropping it ends all that goes on, as [`Bus::close`] does, without waiting.
pub struct Ros2Bus {
    pub(super) inner: Arc<Inner>,
}

/// What all parts of a bus share.
pub(super) struct Inner {
    pub(super) participant: Participant,
    /// The absolute name of this node.
    pub(super) node: String,
    distribution: String,
    /// What the others tell of their nodes.
    pub(super) told: Arc<Told>,
    /// What this node has.
    pub(super) own: Own,
    pub(super) seen: watch::Sender<Arc<Seen>>,
    pub(super) graph: watch::Sender<Arc<Graph>>,
    pub(super) hub: Hub,
    pub(super) subscriptions: Topics,
    pub(super) adverts: Mutex<Adverts>,
    pub(super) clients: Clients,
    pub(super) services: Mutex<HashMap<String, Arc<Served>>>,
    /// What another system lends to the nodes of this one.
    pub(super) loans: Loans,
    /// Of servers of actions that are gone.
    pub(super) retired: Retired,
    /// Changes with the services that are served here.
    pub(super) served: watch::Sender<u64>,
    /// Hears what the others tell.
    listening: Mutex<Option<rtps::Reader>>,
    closed: AtomicBool,
    runtime: Handle,
    tasks: Mutex<JoinSet<()>>,
}

impl Ros2Bus {
    /// Joins the ROS 2 system of a domain.
    pub async fn connect(
        sockets: Arc<dyn Sockets>,
        options: JoinOptions,
    ) -> Result<Arc<Self>, BusError> {
        if !names::is_global(&options.node) {
            return Err(BusError::BadName(options.node));
        }
        let prefix = GuidPrefix::random();
        let predecessors = match &options.succession {
            Some(succession) => succession.joins(&options.node, prefix.0).await,
            None => Vec::new(),
        };
        let network = options.network;
        let config = Config {
            interfaces: network.interfaces,
            multicast: network.multicast,
            alone: network.alone,
            peers: network.peers,
            servers: network.servers,
            well_known: network.well_known,
            user_data: Bytes::from_static(USER_DATA),
            max_sample: options.max_message,
            budget: options.budget,
            unfinished: options.unfinished,
            prefix: Some(prefix),
            predecessors: predecessors.into_iter().map(GuidPrefix).collect(),
            ..Config::new(options.domain, options.node.clone())
        };
        let joined = Participant::join(Arc::new(Place(sockets)), config).await;
        let participant = joined.map_err(not_joined)?;
        let told = Arc::new(Told::default());
        let listening =
            participant.reader(entities::topic(), entities::qos(), Arc::clone(&told) as _);
        let teller = participant.writer(entities::topic(), entities::qos());
        let inner = Arc::new(Inner {
            participant,
            node: options.node,
            distribution: options.distribution,
            told,
            own: Own::default(),
            seen: watch::Sender::default(),
            graph: watch::Sender::default(),
            hub: Hub::default(),
            subscriptions: Topics::default(),
            adverts: Mutex::default(),
            clients: Clients::default(),
            services: Mutex::default(),
            loans: Loans::default(),
            retired: Retired::default(),
            served: watch::Sender::default(),
            listening: Mutex::new(Some(listening)),
            closed: AtomicBool::new(false),
            runtime: Handle::current(),
            tasks: Mutex::default(),
        });
        let mut watcher = Watcher::new(Arc::clone(&inner), teller);
        watcher.look();
        inner.spawn(watcher.run());
        Ok(Arc::new(Self { inner }))
    }

    /// The GUID of this node's participant.
    pub fn guid(&self) -> rtps::Guid {
        self.inner.participant.guid()
    }
}

fn not_joined(error: JoinError) -> BusError {
    let what = "joining ROS 2".to_owned();
    match error {
        JoinError::Socket(source) => BusError::Io { what, source },
        other => BusError::Io {
            what,
            source: io::Error::other(other),
        },
    }
}

impl Drop for Ros2Bus {
    fn drop(&mut self) {
        self.inner.end();
        let participant = self.inner.participant.clone();
        self.inner
            .runtime
            .spawn(async move { participant.close().await });
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

impl Inner {
    /// Runs a task that ends with the bus.
    pub(super) fn spawn(&self, task: impl Future<Output = ()> + Send + 'static) -> AbortHandle {
        let mut tasks = self.tasks.lock();
        while tasks.try_join_next().is_some() {}
        let handle = tasks.spawn_on(task, &self.runtime);
        if self.closed.load(Ordering::Acquire) {
            handle.abort();
        }
        handle
    }

    /// Who is there, as the participant has it: the watcher may not have looked since.
    pub(super) fn discovered(&self) -> Arc<Discovered> {
        Arc::clone(&self.participant.discovered().borrow())
    }

    /// Fails once the bus is closed.
    pub(super) fn check_open(&self) -> Result<(), BusError> {
        if self.closed.load(Ordering::Acquire) {
            return Err(BusError::Closed);
        }
        Ok(())
    }

    /// Whether it is an absolute name, and the bus is open.
    pub(super) fn check_name(&self, name: &str) -> Result<(), BusError> {
        if !names::is_global(name) {
            return Err(BusError::BadName(name.to_owned()));
        }
        self.check_open()
    }

    /// Ends all tasks, and all that came by this bus.
    fn end(&self) {
        self.closed.store(true, Ordering::Release);
        self.tasks.lock().abort_all();
        let topics: Vec<_> = self.subscriptions.lock().drain().collect();
        for (_, topic) in topics {
            topic.end();
        }
        let clients = std::mem::take(&mut *self.clients.lock());
        drop(clients);
        let services = std::mem::take(&mut *self.services.lock());
        drop(services);
        let listening = self.listening.lock().take();
        drop(listening);
    }
}

/// A type by its name in ROS 2, in ROS 2's format where nothing is said of its definition.
fn of_two(of: WireType) -> WireType {
    WireType {
        name: names::full(&of.name, "msg"),
        format: match of.digest.is_any() {
            true => WireFormat::Cdr,
            false => of.format,
        },
        ..of
    }
}

#[async_trait]
impl Bus for Ros2Bus {
    fn version(&self) -> RosVersion {
        RosVersion::Two
    }

    /// What was said when it was joined, or what is seen of it: DDS does not tell.
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

    fn stands_for(&self, nodes: BTreeMap<String, NodeNames>) {
        self.inner.own.stand_for(nodes);
    }

    fn graph(&self) -> watch::Receiver<Arc<Graph>> {
        self.inner.graph.subscribe()
    }

    async fn subscribe(
        &self,
        topic: &str,
        of: WireType,
        qos: Qos,
    ) -> Result<Subscription, BusError> {
        self.inner.check_name(topic)?;
        subscriptions::subscribe(&self.inner, topic, of_two(of), qos)
    }

    async fn advertise(
        &self,
        topic: &str,
        of: WireType,
        qos: Qos,
    ) -> Result<Box<dyn Publisher>, BusError> {
        self.inner.check_name(topic)?;
        publications::advertise(&self.inner, topic, of_two(of), qos).await
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
        calls::find(&self.inner, service, calls::GRACE).await
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
            name: names::full(&service_type.name, "srv"),
            format: WireFormat::Cdr,
            ..service_type
        };
        services::serve(&self.inner, service, of, handler)
    }

    fn action_client(
        &self,
        action: &str,
        of: &Arc<ActionDef>,
    ) -> Result<Box<dyn ActionClient>, BusError> {
        self.inner.check_name(action)?;
        Ok(Box::new(actions::Client::open(&self.inner, action, of)?))
    }

    fn serve_action(
        &self,
        action: &str,
        of: &Arc<ActionDef>,
        handler: Arc<dyn ActionHandler>,
    ) -> Result<Box<dyn ActionServer>, BusError> {
        self.inner.check_name(action)?;
        let server = actions::Server::open(&self.inner, action, of, handler)?;
        Ok(Box::new(server))
    }

    fn node_parameters(&self) -> Result<&dyn NodeParameters, BusError> {
        Ok(self)
    }

    fn lending(&self) -> Result<&dyn Lending, BusError> {
        Ok(self)
    }

    fn process_ended(&self) {
        self.inner.participant.look_at_ports();
    }

    async fn close(&self) {
        if self.inner.closed.swap(true, Ordering::AcqRel) {
            return;
        }
        // What was published or answered until now is still to come.
        let _ = timeout(FAREWELL, self.inner.participant.settled()).await;
        self.inner.end();
        self.inner.participant.close().await;
    }
}
