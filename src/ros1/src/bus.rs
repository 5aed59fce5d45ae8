//! [`Bus`] over ROS 1: an ordinary node, with a slave API and a TCPROS server, that publishes, subscribes, calls and
//! serves on behalf of the owner of the bus.
//!
//! ```text
//!   subscribe ─▶ registrar ─▶ Master ─▶ publisherUpdate, graph ─▶ one link per publisher ─▶ all local queues
//!   advertise ─▶ registrar ─▶ Master;  subscribers connect ─▶ one send_queue each ◀─ publish
//!   call ─▶ lookupService ─▶ pooled persistent connections
//!   serve ─▶ registrar ─▶ Master;  callers connect ─▶ handler
//! ```
//! The registrar keeps what this node wants registered; the graph watcher compares it with what the Master has, so that
//! everything is registered again with a Master that was restarted or lost our registrations.

mod actions;
mod bus_info;
mod calls;
mod endpoint_owner;
mod lending;
mod link;
mod master_client;
mod parameters;
pub(super) mod publications;
mod registrar;
mod server;
mod services;
mod slave;
mod state;
pub(super) mod subscriptions;
mod topic_in;
mod topic_out;
mod topic_type;
mod watcher;

use std::collections::BTreeSet;
use std::fmt;
use std::future::Future;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::atomic::{AtomicBool, AtomicI32, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use ros_bus::net::Sockets;
use ros_bus::{
    ActionClient, ActionHandler, ActionServer, Bus, BusError, Digest, GlobalParameters, Graph, JoinOptions, Lending,
    Offer, ParamValue, PeerId, Publisher, PublisherReports, QosProfile, RosVersion, ServiceHandler, ServiceType,
    Subscription, WireType,
};
use ros_message::schema::ActionDef;
use tokio::runtime::Handle;
use tokio::sync::{Notify, watch};
use tokio::task::AbortHandle;
use tracing::{Instrument, Span};

pub(super) use self::endpoint_owner::EndpointOwner;
use self::master_client::MasterClient;
use self::registrar::Registrar;
pub(super) use self::state::Ros1BusState;
use self::state::{CallPool, FAREWELL, HANDSHAKE, Loans, PublisherClients};
use super::names;
use crate::tcpros::FrameBounds;
use crate::xmlrpc::{self, ServerLimits, XmlRpcClient};

/// A ROS 1 system as a [`Bus`]. Dropping it closes all connections but leaves the registrations, as a crash would;
/// [`Bus::close`] unregisters everything.
pub struct Ros1Bus {
    inner: Arc<Ros1BusState>,
}

impl Ros1Bus {
    /// Joins the ROS system of the Master at `master` as node `node_name`.
    pub async fn connect(
        sockets: Arc<dyn Sockets>,
        master: SocketAddr,
        node_name: &str,
    ) -> Result<Arc<Self>, BusError> {
        Self::connect_with(sockets, JoinOptions::new(master, node_name)).await
    }

    /// Joins a ROS system. Fails if the Master does not answer now.
    pub async fn connect_with(sockets: Arc<dyn Sockets>, options: JoinOptions) -> Result<Arc<Self>, BusError> {
        if !names::is_global(&options.node) {
            return Err(BusError::BadName(options.node));
        }
        let io = |what: String| move |source: io::Error| BusError::Io { what, source };
        let to_master = format!("ROS Master at {}", options.master);
        let connecting = tokio::time::timeout(HANDSHAKE, sockets.connect(options.master));
        let local = match connecting.await {
            Ok(connected) => connected.map_err(io(to_master))?.local_addr(),
            Err(_) => {
                return Err(BusError::Timeout { what: to_master, after: HANDSHAKE });
            }
        };
        let local = local.map_err(io("own address".to_owned()))?.ip();
        let listen = |what: &str| {
            let what = format!("listening for {what}");
            let ip = if local.is_loopback() { local } else { IpAddr::V4(Ipv4Addr::UNSPECIFIED) };
            let sockets = sockets.clone();
            async move {
                let listener = sockets.listen(SocketAddr::new(ip, 0)).await;
                listener.and_then(|listener| Ok((listener.local_addr()?.port(), listener))).map_err(io(what))
            }
        };
        let (port, tcpros_listener) = listen("TCPROS").await?;
        let (slave_port, slave_listener) = listen("XML-RPC").await?;
        let host = options.host.unwrap_or_else(|| match local {
            IpAddr::V4(ip) => ip.to_string(),
            IpAddr::V6(ip) => format!("[{ip}]"),
        });
        let master = Arc::new(MasterClient::new(sockets.clone(), options.master, &options.node, &options.budget)?);
        let registrar =
            Registrar::new(master.clone(), format!("http://{host}:{slave_port}/"), format!("rosrpc://{host}:{port}"));
        let inner = Arc::new(Ros1BusState {
            sockets,
            node: options.node,
            host,
            port,
            frames: FrameBounds {
                max: options.max_message,
                budget: options.budget.clone(),
                unfinished: options.unfinished,
            },
            master,
            registrar,
            subscriptions: Mutex::default(),
            publications: Mutex::default(),
            publishing: Notify::new(),
            services: Mutex::default(),
            label: OnceLock::new(),
            lending: Loans::default(),
            calls: CallPool::default(),
            publisher_clients: PublisherClients::default(),
            graph: watch::Sender::new(Arc::default()),
            shutdown: watch::Sender::new(None),
            param_watchers: Mutex::default(),
            closed: AtomicBool::new(false),
            runtime: Handle::current(),
            log_span: Span::current(),
            tasks: Mutex::default(),
            next_id: AtomicI32::new(1),
        });
        // Owned from here on: an error below stops the tasks.
        let bus = Arc::new(Self { inner: inner.clone() });
        let slave = Arc::new(slave::Slave { bus: inner.clone() });
        let limits = ServerLimits {
            budget: options.budget.child("the XML-RPC of our node", xmlrpc::MAX_HELD),
            ..ServerLimits::default()
        };
        inner.spawn(xmlrpc::serve(slave_listener, slave, limits));
        inner.spawn(server::serve(inner.clone(), tcpros_listener));
        let watcher = watcher::start(inner.clone()).await?;
        inner.spawn(options.budget.meter(watcher.run()));
        Ok(bus)
    }

    /// Returns the address of this node's slave API, as known to the Master.
    pub fn uri(&self) -> &str {
        self.inner.registrar.slave_uri()
    }
}

impl Drop for Ros1Bus {
    fn drop(&mut self) {
        self.inner.shut_down();
    }
}

impl fmt::Debug for Ros1Bus {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("Ros1Bus")
            .field("node", &self.inner.node)
            .field("uri", &self.uri())
            .finish_non_exhaustive()
    }
}

impl Ros1BusState {
    /// Spawns a task that ends with the bus.
    pub(super) fn spawn(&self, task: impl Future<Output = ()> + Send + 'static) -> AbortHandle {
        let mut tasks = self.tasks.lock();
        while tasks.try_join_next().is_some() {}
        let task = task.instrument(self.log_span.clone());
        let handle = tasks.spawn_on(task, &self.runtime);
        if self.closed.load(Ordering::Acquire) {
            handle.abort();
        }
        handle
    }

    /// Returns a new number for a connection or a local registration.
    pub(super) fn next_id(&self) -> i32 {
        self.next_id.fetch_add(1, Ordering::Relaxed)
    }

    /// Creates a client of the node at `uri`.
    fn client(&self, uri: &str) -> Result<XmlRpcClient, BusError> {
        let client = XmlRpcClient::new(self.sockets.clone(), uri).map_err(master_client::to_bus_error)?;
        Ok(client.with_budget(&self.frames.budget))
    }

    /// Subscribes to all parameter changes at the Master if there is a watcher.
    async fn subscribe_params(&self) -> Result<(), BusError> {
        if self.param_watchers.lock().is_empty() {
            return Ok(());
        }
        let args = vec![self.registrar.slave_uri().into(), "/".into()];
        self.master.call("subscribeParam", args).await.map(drop)
    }

    fn check_open(&self) -> Result<(), BusError> {
        if self.closed.load(Ordering::Acquire) {
            return Err(BusError::Closed);
        }
        Ok(())
    }

    fn check_name(&self, name: &str) -> Result<(), BusError> {
        if !names::is_global(name) {
            return Err(BusError::BadName(name.to_owned()));
        }
        self.check_open()
    }

    /// Ends all tasks and with them all connections.
    fn shut_down(&self) {
        self.closed.store(true, Ordering::Release);
        self.tasks.lock().abort_all();
        for (_, topic) in self.subscriptions.lock().drain() {
            topic.close();
        }
        self.publications.lock().clear();
        self.param_watchers.lock().clear();
        self.services.lock().clear();
        self.lending.clear();
        self.calls.clear();
    }
}

#[async_trait]
impl Bus for Ros1Bus {
    fn version(&self) -> RosVersion {
        RosVersion::One
    }

    /// Reads `/rosdistro` as set by roslaunch.
    async fn distribution(&self) -> String {
        match self.get("/rosdistro").await {
            Ok(ParamValue::String(distribution)) => distribution.trim().to_owned(),
            _ => "noetic".to_owned(),
        }
    }

    fn node(&self) -> &str {
        &self.inner.node
    }

    fn graph(&self) -> watch::Receiver<Arc<Graph>> {
        self.inner.graph.subscribe()
    }

    async fn subscribe(&self, topic: &str, of: WireType, qos: QosProfile) -> Result<Subscription, BusError> {
        self.inner.check_name(topic)?;
        subscriptions::subscribe(&self.inner, topic, of, qos, EndpointOwner::User).await
    }

    async fn advertise(&self, topic: &str, of: WireType, qos: QosProfile) -> Result<Box<dyn Publisher>, BusError> {
        self.inner.check_name(topic)?;
        publications::advertise(&self.inner, topic, of, qos, EndpointOwner::User).await
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
        let provider = self.provider(service).await?;
        Ok(provider.service_type)
    }

    async fn topic_type(&self, topic: &str) -> Result<WireType, BusError> {
        let offer = self.topic_offer(topic).await?;
        Ok(WireType::clone(&offer.wire_type))
    }

    async fn topic_offer(&self, topic: &str) -> Result<Offer, BusError> {
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
        services::serve(&self.inner, service, service_type, handler).await
    }

    fn action_client(&self, action: &str, of: &Arc<ActionDef>) -> Result<Box<dyn ActionClient>, BusError> {
        self.inner.check_name(action)?;
        Ok(Box::new(actions::Ros1ActionClient::open(&self.inner, action, of)))
    }

    fn serve_action(
        &self,
        action: &str,
        of: &Arc<ActionDef>,
        handler: Arc<dyn ActionHandler>,
    ) -> Result<Box<dyn ActionServer>, BusError> {
        self.inner.check_name(action)?;
        let server = actions::Ros1ActionServer::open(&self.inner, action, of, handler);
        Ok(Box::new(server))
    }

    fn parameters(&self) -> Result<&dyn GlobalParameters, BusError> {
        Ok(self)
    }

    fn lending(&self) -> Result<&dyn Lending, BusError> {
        Ok(self)
    }

    fn publisher_reports(&self) -> Option<&dyn PublisherReports> {
        Some(self)
    }

    /// Requested by `rosnode kill`, or when another node of the same name registers.
    fn shutdown_requested(&self) -> Option<watch::Receiver<Option<String>>> {
        Some(self.inner.shutdown.subscribe())
    }

    async fn close(&self) {
        if self.inner.closed.swap(true, Ordering::AcqRel) {
            return;
        }
        let farewell = async {
            let publications: Vec<_> = self.inner.publications.lock().drain().collect();
            for (_, topic) in &publications {
                topic.retire();
            }
            let is_watching = !std::mem::take(&mut *self.inner.param_watchers.lock()).is_empty();
            if is_watching {
                let args = vec![self.inner.registrar.slave_uri().into(), "/".into()];
                let _ = self.inner.master.call("unsubscribeParam", args).await;
            }
            self.inner.registrar.withdraw_all().await;
            for (_, topic) in &publications {
                topic.wait_until_no_subscribers().await;
            }
        };
        let _ = tokio::time::timeout(FAREWELL, farewell).await;
        self.inner.shut_down();
    }
}

#[async_trait]
impl PublisherReports for Ros1Bus {
    async fn reported_connections(&self, topic: &str) -> Result<BTreeSet<PeerId>, BusError> {
        bus_info::connections(&self.inner, topic).await
    }
}

#[cfg(test)]
mod tests;
