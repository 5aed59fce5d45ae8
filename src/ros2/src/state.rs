//! State shared by all parts of a bus.

use std::collections::HashMap;
use std::future::Future;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

use parking_lot::Mutex;
use ros_bus::{BusError, Graph, WireType};
use rtps::{DiscoveredGraph, Participant};
use tokio::runtime::Handle;
use tokio::sync::watch;
use tokio::task::{AbortHandle, JoinSet};
use tracing::{Instrument, Span};

use super::client::ServiceClient;
use super::ends::LocalEndpointTable;
use super::entities::ParticipantTable;
use super::names;
use super::raw::Hub;
use super::seen::DiscoverySnapshot;
use super::services::ServedService;
use super::topic_in::{ReaderSetKey, TopicIn};

/// State shared by all parts of a bus.
pub(super) struct Ros2BusState {
    pub(super) participant: Participant,
    /// Absolute name of this node.
    pub(super) node: String,
    pub(super) distribution: String,
    /// Nodes announced by the other participants.
    pub(super) told: Arc<ParticipantTable>,
    /// Endpoints of this node.
    pub(super) own: LocalEndpointTable,
    pub(super) seen: watch::Sender<Arc<DiscoverySnapshot>>,
    pub(super) graph: watch::Sender<Arc<Graph>>,
    pub(super) hub: Hub,
    pub(super) subscriptions: TopicMap,
    pub(super) adverts: Mutex<Adverts>,
    pub(super) clients: Clients,
    pub(super) services: Mutex<HashMap<String, Arc<ServedService>>>,
    /// Services of another system lent to the nodes of this one.
    pub(super) loans: Loans,
    /// Services of action servers that are gone.
    pub(super) retired: RetiredServices,
    /// Changes with the services that are served here.
    pub(super) served: watch::Sender<u64>,
    /// Reader of what the others announce.
    pub(super) listening: Mutex<Option<rtps::DataReader>>,
    pub(super) closed: AtomicBool,
    pub(super) runtime: Handle,
    /// Span of the log in which the bus was joined, for all its tasks.
    pub(super) log_span: Span,
    pub(super) tasks: Mutex<JoinSet<()>>,
}

impl Ros2BusState {
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

    /// Returns the participant's current discovery state; the watcher may lag behind.
    pub(super) fn discovery(&self) -> Arc<DiscoveredGraph> {
        Arc::clone(&self.participant.watch_discovered().borrow())
    }

    /// Fails once the bus is closed.
    pub(super) fn check_open(&self) -> Result<(), BusError> {
        if self.closed.load(Ordering::Acquire) {
            return Err(BusError::Closed);
        }
        Ok(())
    }

    /// Checks that the name is absolute and the bus open.
    pub(super) fn check_name(&self, name: &str) -> Result<(), BusError> {
        if !names::is_global(name) {
            return Err(BusError::BadName(name.to_owned()));
        }
        self.check_open()
    }

    /// Ends all tasks and everything that uses this bus.
    pub(super) fn shut_down(&self) {
        self.closed.store(true, Ordering::Release);
        self.tasks.lock().abort_all();
        let topics: Vec<_> = self.subscriptions.lock().drain().collect();
        for (_, topic) in topics {
            topic.close();
        }
        let clients = std::mem::take(&mut *self.clients.lock());
        drop(clients);
        let services = std::mem::take(&mut *self.services.lock());
        drop(services);
        let listening = self.listening.lock().take();
        drop(listening);
    }
}

/// Topics that are subscribed to.
pub(super) type TopicMap = Mutex<HashMap<ReaderSetKey, Arc<TopicIn>>>;

/// Advertised topics with their type and the number of advertisements.
pub(super) type Adverts = HashMap<String, (Arc<WireType>, usize)>;

/// Clients that are kept, by service and type.
pub(super) type Clients = Mutex<HashMap<(String, String), Arc<ServiceClient>>>;

/// The lending task of a bus, and the label of its services.
#[derive(Default)]
pub(super) struct Loans {
    pub(super) following: Mutex<Option<AbortHandle>>,
    pub(super) label: OnceLock<String>,
}

/// Keeps a service running until dropped.
pub(super) type BoxedGuard = Box<dyn Send + Sync>;

/// The services of a bus that answer a little longer, by action.
#[derive(Default)]
pub(super) struct RetiredServices {
    pub(super) actions: Mutex<RetiredActions>,
}

/// Retired services, and how many there have been.
#[derive(Default)]
pub(super) struct RetiredActions {
    pub(super) count: u64,
    pub(super) kept: HashMap<String, (u64, BoxedGuard)>,
}
