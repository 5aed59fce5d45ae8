//! [`Bus`] over ROS 1: an ordinary node, with a slave API and a TCPROS server, that publishes, subscribes, calls
//! and serves on behalf of whoever holds the bus.
//!
//! ```text
//!   subscribe ─▶ registrar ─▶ Master ─▶ publisherUpdate, graph ─▶ one link per publisher ─▶ all local queues
//!   advertise ─▶ registrar ─▶ Master;  subscribers connect ─▶ one outbox each ◀─ publish
//!   call ─▶ lookupService ─▶ pooled persistent connections
//!   serve ─▶ registrar ─▶ Master;  callers connect ─▶ handler
//! ```
//! What this side wants registered is kept by the registrar; the graph watcher compares it with what the Master
//! has, so a Master that restarted, or forgot us, is told again.

mod calls;
mod heard;
mod lending;
mod link;
mod master_client;
mod publications;
mod registrar;
mod server;
mod services;
mod slave;
mod subscriptions;
mod topic_type;
mod watcher;

use std::collections::{BTreeSet, HashMap};
use std::fmt;
use std::future::Future;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::atomic::{AtomicBool, AtomicI32, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use async_trait::async_trait;
use budget::Budget;
use bytes::Bytes;
use parking_lot::Mutex;
use tokio::runtime::Handle;
use tokio::sync::{mpsc, watch};
use tokio::task::{AbortHandle, JoinSet};

use self::calls::CallPool;
use self::lending::Lending;
use self::master_client::MasterClient;
use self::publications::TopicOut;
use self::registrar::Registrar;
use self::services::Served;
use self::subscriptions::TopicIn;
use super::{names, tcpros};
use crate::bus::{
    AdvertiseOptions, Bus, BusError, Graph, Lender, ParamChange, ParamChanges, ParamValue,
    Publisher, ServiceHandler, ServiceProvider, ServiceType, SubscribeOptions, Subscription,
    WireType,
};
use crate::net::Sockets;
use crate::ros1::tcpros::FrameBounds;
use crate::ros1::xmlrpc::{self, Client, Limits, Value};

/// For a peer to accept a connection and answer its header.
const HANDSHAKE: Duration = Duration::from_secs(10);
/// For queued messages and unregistrations when the bus closes.
const FAREWELL: Duration = Duration::from_secs(2);

/// How to join a ROS 1 system.
#[derive(Debug, Clone)]
pub struct Ros1Options {
    /// Where the Master listens, as seen from the sockets' place.
    pub master: SocketAddr,
    /// The node's absolute name.
    pub node_name: String,
    /// The host that other nodes reach this one under; the address used towards the Master where `None`.
    pub host: Option<String>,
    /// A message longer than this ends its connection.
    pub max_message: usize,
    /// Where what is read from nodes counts until it is whole; what does not fit ends its connection.
    pub budget: Budget,
    /// A message that was begun and is not whole after this time ends its connection.
    pub unfinished: Duration,
}

impl Ros1Options {
    /// A node of this name at this Master.
    pub fn new(master: SocketAddr, node_name: &str) -> Self {
        Self {
            master,
            node_name: node_name.to_owned(),
            host: None,
            max_message: tcpros::MAX_MESSAGE,
            budget: Budget::unlimited(),
            unfinished: tcpros::UNFINISHED,
        }
    }
}

/// A ROS 1 system as a [`Bus`]. Dropping it closes all connections but leaves the registrations, as a crash
/// would; [`Bus::close`] takes them back.
pub struct Ros1Bus {
    inner: Arc<Inner>,
}

/// What all parts of a bus share.
struct Inner {
    sockets: Arc<dyn Sockets>,
    node: String,
    /// The host in our addresses, and the port of our TCPROS server.
    host: String,
    port: u16,
    frames: FrameBounds,
    master: Arc<MasterClient>,
    registrar: Registrar,
    subscriptions: Mutex<HashMap<String, Arc<TopicIn>>>,
    publications: Mutex<HashMap<String, Arc<TopicOut>>>,
    services: Mutex<HashMap<String, Arc<Served>>>,
    label: OnceLock<String>,
    lending: Lending,
    calls: CallPool,
    publisher_clients: heard::PublisherClients,
    graph: watch::Sender<Arc<Graph>>,
    shutdown: watch::Sender<Option<String>>,
    param_watcher: Mutex<Option<mpsc::UnboundedSender<ParamChange>>>,
    closed: AtomicBool,
    runtime: Handle,
    tasks: Mutex<JoinSet<()>>,
    next_id: AtomicI32,
}

impl Ros1Bus {
    /// Joins the ROS system of the Master at `master` as node `node_name`.
    pub async fn connect(
        sockets: Arc<dyn Sockets>,
        master: SocketAddr,
        node_name: &str,
    ) -> Result<Arc<Self>, BusError> {
        Self::connect_with(sockets, Ros1Options::new(master, node_name)).await
    }

    /// Joins a ROS system. Fails if the Master does not answer now.
    pub async fn connect_with(
        sockets: Arc<dyn Sockets>,
        options: Ros1Options,
    ) -> Result<Arc<Self>, BusError> {
        if !names::is_global(&options.node_name) {
            return Err(BusError::BadName(options.node_name));
        }
        let io = |what: String| move |source: io::Error| BusError::Io { what, source };
        let to_master = format!("ROS Master at {}", options.master);
        let connecting = tokio::time::timeout(HANDSHAKE, sockets.connect(options.master));
        let local = match connecting.await {
            Ok(connected) => connected.map_err(io(to_master))?.local_addr(),
            Err(_) => {
                return Err(BusError::Timeout {
                    what: to_master,
                    after: HANDSHAKE,
                });
            }
        };
        let local = local.map_err(io("own address".to_owned()))?.ip();
        let listen = |what: &str| {
            let what = format!("listening for {what}");
            let ip = if local.is_loopback() {
                local
            } else {
                IpAddr::V4(Ipv4Addr::UNSPECIFIED)
            };
            let sockets = sockets.clone();
            async move {
                let listener = sockets.listen(SocketAddr::new(ip, 0)).await;
                listener
                    .and_then(|listener| Ok((listener.local_addr()?.port(), listener)))
                    .map_err(io(what))
            }
        };
        let (port, tcpros_listener) = listen("TCPROS").await?;
        let (slave_port, slave_listener) = listen("XML-RPC").await?;
        let host = options.host.unwrap_or_else(|| match local {
            IpAddr::V4(ip) => ip.to_string(),
            IpAddr::V6(ip) => format!("[{ip}]"),
        });
        let master = Arc::new(MasterClient::new(
            sockets.clone(),
            options.master,
            &options.node_name,
            &options.budget,
        )?);
        let registrar = Registrar::new(
            master.clone(),
            format!("http://{host}:{slave_port}/"),
            format!("rosrpc://{host}:{port}"),
        );
        let inner = Arc::new(Inner {
            sockets,
            node: options.node_name,
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
            services: Mutex::default(),
            label: OnceLock::new(),
            lending: Lending::default(),
            calls: CallPool::default(),
            publisher_clients: heard::PublisherClients::default(),
            graph: watch::Sender::new(Arc::default()),
            shutdown: watch::Sender::new(None),
            param_watcher: Mutex::default(),
            closed: AtomicBool::new(false),
            runtime: Handle::current(),
            tasks: Mutex::default(),
            next_id: AtomicI32::new(1),
        });
        // Owned from here on: an error below stops the tasks.
        let bus = Arc::new(Self {
            inner: inner.clone(),
        });
        let slave = Arc::new(slave::Slave { bus: inner.clone() });
        let limits = Limits {
            budget: options
                .budget
                .within("the XML-RPC of our node", xmlrpc::MAX_HELD),
            ..Limits::default()
        };
        inner.spawn(xmlrpc::serve(slave_listener, slave, limits));
        inner.spawn(server::serve(inner.clone(), tcpros_listener));
        let watcher = watcher::start(inner.clone()).await?;
        inner.spawn(watcher.run());
        Ok(bus)
    }

    /// This node's name.
    pub fn node_name(&self) -> &str {
        &self.inner.node
    }

    /// The address of this node's slave API, as the Master knows it.
    pub fn uri(&self) -> &str {
        self.inner.registrar.slave_uri()
    }

    /// Is told to whoever calls or probes services of this node, by those that are served from now on: what belongs
    /// together knows itself by it. The first one stays.
    pub fn set_label(&self, label: &str) {
        let _ = self.inner.label.set(label.to_owned());
    }

    /// Becomes the reason when someone asked this node to end (`rosnode kill`, or another node of the same
    /// name). The bus itself goes on: whether to obey is its owner's decision.
    pub fn shutdown_requested(&self) -> watch::Receiver<Option<String>> {
        self.inner.shutdown.subscribe()
    }
}

impl Drop for Ros1Bus {
    fn drop(&mut self) {
        self.inner.end();
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

impl Inner {
    /// Runs a task that ends with the bus.
    fn spawn(&self, task: impl Future<Output = ()> + Send + 'static) -> AbortHandle {
        let mut tasks = self.tasks.lock();
        while tasks.try_join_next().is_some() {}
        let handle = tasks.spawn_on(task, &self.runtime);
        if self.closed.load(Ordering::Acquire) {
            handle.abort();
        }
        handle
    }

    /// A number for a connection or a local registration.
    fn id(&self) -> i32 {
        self.next_id.fetch_add(1, Ordering::Relaxed)
    }

    /// A client of the node at `uri`.
    fn client(&self, uri: &str) -> Result<Client, BusError> {
        let client = Client::new(self.sockets.clone(), uri).map_err(master_client::to_bus_error)?;
        Ok(client.within(&self.frames.budget))
    }

    /// Asks the Master for every change, if anybody watches.
    async fn subscribe_params(&self) -> Result<(), BusError> {
        if self.param_watcher.lock().is_none() {
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
    fn end(&self) {
        self.closed.store(true, Ordering::Release);
        self.tasks.lock().abort_all();
        for (_, topic) in self.subscriptions.lock().drain() {
            topic.end();
        }
        self.publications.lock().clear();
        *self.param_watcher.lock() = None;
        self.services.lock().clear();
        self.lending.end();
        self.calls.clear();
    }
}

#[async_trait]
impl Bus for Ros1Bus {
    fn node(&self) -> &str {
        &self.inner.node
    }

    fn graph(&self) -> watch::Receiver<Arc<Graph>> {
        self.inner.graph.subscribe()
    }

    async fn subscribe(
        &self,
        topic: &str,
        options: SubscribeOptions,
    ) -> Result<Subscription, BusError> {
        self.inner.check_name(topic)?;
        subscriptions::subscribe(&self.inner, topic, options).await
    }

    async fn advertise(
        &self,
        topic: &str,
        options: AdvertiseOptions,
    ) -> Result<Box<dyn Publisher>, BusError> {
        self.inner.check_name(topic)?;
        publications::advertise(&self.inner, topic, options).await
    }

    async fn call(
        &self,
        service: &str,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, BusError> {
        self.inner.check_name(service)?;
        calls::call(&self.inner, service, None, request, timeout).await
    }

    async fn call_typed(
        &self,
        service: &str,
        md5: &str,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, BusError> {
        self.inner.check_name(service)?;
        calls::call(&self.inner, service, Some(md5), request, timeout).await
    }

    async fn service_type(&self, service: &str) -> Result<ServiceType, BusError> {
        let provider = self.service_provider(service).await?;
        Ok(provider.service_type)
    }

    async fn service_provider(&self, service: &str) -> Result<ServiceProvider, BusError> {
        self.inner.check_name(service)?;
        calls::probe(&self.inner, service).await
    }

    async fn lend(&self, lender: Arc<dyn Lender>) -> Result<(), BusError> {
        self.inner.check_open()?;
        self.inner.lending.begin(lender);
        self.inner.tell_that_it_lends().await
    }

    async fn topic_type(&self, topic: &str) -> Result<WireType, BusError> {
        self.inner.check_name(topic)?;
        topic_type::find(&self.inner, topic).await
    }

    async fn heard_over(&self, topic: &str) -> Result<BTreeSet<(String, i32)>, BusError> {
        heard::connections(&self.inner, topic).await
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

    async fn get_param(&self, key: &str) -> Result<ParamValue, BusError> {
        match self.inner.master.ask("getParam", vec![key.into()]).await? {
            Ok(value) => Ok(value.into()),
            Err(_) => Err(BusError::NoParam(key.to_owned())),
        }
    }

    async fn set_param(&self, key: &str, value: ParamValue) -> Result<(), BusError> {
        let value = Value::try_from(value).map_err(|reason| BusError::BadParam {
            key: key.to_owned(),
            reason,
        })?;
        let set = self.inner.master.call("setParam", vec![key.into(), value]);
        set.await.map(drop)
    }

    async fn delete_param(&self, key: &str) -> Result<(), BusError> {
        let answer = self.inner.master.ask("deleteParam", vec![key.into()]);
        match answer.await? {
            Ok(_) => Ok(()),
            Err(_) => Err(BusError::NoParam(key.to_owned())),
        }
    }

    async fn has_param(&self, key: &str) -> Result<bool, BusError> {
        let has = self.inner.master.call("hasParam", vec![key.into()]).await?;
        Ok(has == Value::Bool(true))
    }

    async fn search_param(&self, namespace: &str, key: &str) -> Result<Option<String>, BusError> {
        let asker = names::canonical(namespace);
        let found = self
            .inner
            .master
            .ask_as(&asker, "searchParam", vec![key.into()]);
        Ok(match found.await? {
            Ok(Value::String(found)) => Some(found),
            _ => None,
        })
    }

    async fn param_names(&self) -> Result<Vec<String>, BusError> {
        let names = self.inner.master.call("getParamNames", vec![]).await?;
        Ok(names.to_strings())
    }

    async fn watch_params(&self) -> Result<ParamChanges, BusError> {
        self.inner.check_open()?;
        let (sender, changes) = mpsc::unbounded_channel();
        *self.inner.param_watcher.lock() = Some(sender);
        self.inner.subscribe_params().await?;
        Ok(changes)
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
            if self.inner.param_watcher.lock().take().is_some() {
                let args = vec![self.inner.registrar.slave_uri().into(), "/".into()];
                let _ = self.inner.master.call("unsubscribeParam", args).await;
            }
            self.inner.registrar.withdraw_all().await;
            for (_, topic) in &publications {
                topic.emptied().await;
            }
        };
        let _ = tokio::time::timeout(FAREWELL, farewell).await;
        self.inner.end();
    }
}

#[cfg(test)]
mod tests;
