//! What a bridge's sessions, topics and services have in common.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Weak};

use parking_lot::Mutex;
use ros::bus::{Bus, PeerId};
use ros::schema::{MessageType, Registry};
use tokio::sync::watch;

use crate::bridge::SessionCount;
use crate::client::Client;
use crate::hub::Hub;
use crate::outlet::Outlet;
use crate::presence::{self, Presence};
use crate::registrations::Registrations;
use crate::service_types::ServiceTypes;
use crate::tf::{self, Republisher};
use crate::{BridgeOptions, Metrics, SessionOptions};

/// What the bridge's parts need of it.
pub(crate) struct Shared {
    pub(crate) bus: Arc<dyn Bus>,
    pub(crate) registry: Arc<Registry>,
    pub(crate) options: BridgeOptions,
    pub(crate) metrics: Arc<Metrics>,
    pub(crate) service_types: ServiceTypes,
    pub(crate) registrations: Registrations,
    pub(crate) presence: Presence,
    pub(crate) republisher: Republisher,
    hubs: Mutex<HashMap<String, Weak<Hub>>>,
    /// What clients publish on, by topic.
    outlets: Mutex<HashMap<String, Vec<Weak<Outlet>>>>,
    clients: Mutex<Clients>,
    pub(crate) sessions: watch::Sender<SessionCount>,
    numbers: AtomicU64,
}

#[derive(Default)]
struct Clients {
    all: Vec<Weak<Client>>,
    /// Clients that can be resumed, by token.
    resumable: HashMap<String, Arc<Client>>,
    closed: Option<String>,
}

impl Shared {
    pub(crate) fn new(
        bus: Arc<dyn Bus>,
        registry: Arc<Registry>,
        options: BridgeOptions,
    ) -> Arc<Self> {
        presence::define(&registry);
        tf::define(&registry);
        Arc::new(Self {
            bus,
            registry,
            options,
            metrics: Arc::default(),
            service_types: ServiceTypes::default(),
            registrations: Registrations::default(),
            presence: Presence::default(),
            republisher: Republisher::default(),
            hubs: Mutex::default(),
            outlets: Mutex::default(),
            clients: Mutex::default(),
            sessions: watch::Sender::default(),
            numbers: AtomicU64::new(1),
        })
    }

    /// Refuses clients from now on; gives those there are.
    pub(crate) fn close(&self, reason: &str) -> Vec<Arc<Client>> {
        let mut clients = self.clients.lock();
        clients.closed.get_or_insert_with(|| reason.to_owned());
        clients.resumable.clear();
        clients
            .all
            .drain(..)
            .filter_map(|client| client.upgrade())
            .collect()
    }

    /// The client that a connection belongs to: the one it was before, or a new one.
    pub(crate) fn client_for(
        self: &Arc<Self>,
        options: &SessionOptions,
    ) -> Result<Arc<Client>, String> {
        let mut clients = self.clients.lock();
        if let Some(reason) = &clients.closed {
            return Err(reason.clone());
        }
        if let Some(token) = &options.resume
            && let Some(client) = clients.resumable.get(token)
        {
            self.metrics.resumed.add(1);
            return Ok(client.clone());
        }
        let client = Client::new(self.clone(), options);
        clients.all.retain(|other| other.strong_count() > 0);
        clients.all.push(Arc::downgrade(&client));
        if let Some(token) = &options.resume {
            clients.resumable.insert(token.clone(), client.clone());
        }
        Ok(client)
    }

    pub(crate) fn forget_client(&self, client: &Arc<Client>, token: &str) {
        let mut clients = self.clients.lock();
        if clients
            .resumable
            .get(token)
            .is_some_and(|known| Arc::ptr_eq(known, client))
        {
            clients.resumable.remove(token);
        }
        drop(clients);
        client.end();
    }

    /// The topic's hub; begun if it is not there.
    pub(crate) fn hub(
        self: &Arc<Self>,
        topic: &str,
        message_type: Option<&MessageType>,
    ) -> Arc<Hub> {
        let mut hubs = self.hubs.lock();
        if let Some(hub) = hubs.get(topic).and_then(Weak::upgrade) {
            return hub;
        }
        let hub = match self.own_topic(topic) {
            Some(own) => {
                let hub = Hub::internal(self, topic);
                if presence::type_name(topic).is_some() {
                    self.tell_presence_to(&hub, &own);
                }
                hub
            }
            None => Hub::start(self, topic, message_type),
        };
        let outlets = self.outlets_of(topic);
        for message in outlets.iter().filter_map(|outlet| outlet.latched()) {
            hub.deliver(message, true);
        }
        hubs.insert(topic.to_owned(), Arc::downgrade(&hub));
        // The last owner of an outlet must not drop it under the lock.
        drop(hubs);
        hub
    }

    /// The type of a topic that the bridge itself publishes, unless a node of the servant has one of this name.
    fn own_topic(&self, topic: &str) -> Option<Arc<MessageType>> {
        let name = presence::type_name(topic).or_else(|| self.republisher.type_name(topic))?;
        let taken = self.bus.graph().borrow().topics.contains_key(topic);
        self.registry.message(name).ok().filter(|_| !taken)
    }

    /// Tells who listens that somebody has come or gone.
    pub(crate) fn tell_presence(&self) {
        for topic in presence::TOPICS {
            let hub = self.live_hub(topic).filter(|hub| hub.is_internal());
            let own = presence::type_name(topic).and_then(|name| self.registry.message(name).ok());
            if let (Some(hub), Some(own)) = (hub, own) {
                self.tell_presence_to(&hub, &own);
            }
        }
    }

    fn tell_presence_to(&self, hub: &Hub, of: &MessageType) {
        if let Some(message) = self.presence.message(&hub.topic, of) {
            hub.deliver(message, true);
        }
    }

    fn outlets_of(&self, topic: &str) -> Vec<Arc<Outlet>> {
        self.outlets
            .lock()
            .get(topic)
            .into_iter()
            .flatten()
            .filter_map(Weak::upgrade)
            .collect()
    }

    /// Whether the client that published so still does.
    pub(crate) fn has_outlet(&self, topic: &str, id: &PeerId) -> bool {
        self.outlets_of(topic).iter().any(|outlet| outlet.id == *id)
    }

    pub(crate) fn add_outlet(&self, outlet: &Arc<Outlet>) {
        self.outlets
            .lock()
            .entry(outlet.topic.clone())
            .or_default()
            .push(Arc::downgrade(outlet));
    }

    /// Forgets an outlet that is being dropped, and what it latched.
    pub(crate) fn forget_outlet(&self, outlet: &Outlet) {
        let mut outlets = self.outlets.lock();
        if let Some(others) = outlets.get_mut(&outlet.topic) {
            others.retain(|other| other.strong_count() > 0);
            if others.is_empty() {
                outlets.remove(&outlet.topic);
            }
        }
        drop(outlets);
        if outlet.latch
            && let Some(hub) = self.live_hub(&outlet.topic)
        {
            hub.forget(&outlet.id);
        }
    }

    /// What clients of this bridge publish on a topic, known before the graph shows it.
    pub(crate) fn local_type(&self, topic: &str) -> Option<String> {
        let outlets = self.outlets_of(topic);
        let known = outlets.first().map(|outlet| outlet.message_type.name());
        known
            .or(presence::type_name(topic))
            .or_else(|| self.republisher.type_name(topic))
            .map(str::to_owned)
    }

    /// The topic's hub, if anybody listens.
    pub(crate) fn live_hub(&self, topic: &str) -> Option<Arc<Hub>> {
        self.hubs.lock().get(topic).and_then(Weak::upgrade)
    }

    /// Forgets a hub that is gone, or that will never carry anything.
    pub(crate) fn forget_hub(&self, hub: &Hub) {
        let mut hubs = self.hubs.lock();
        if hubs
            .get(&hub.topic)
            .is_some_and(|known| std::ptr::eq(known.as_ptr(), hub))
        {
            hubs.remove(&hub.topic);
        }
    }

    /// A number that nothing else of this bridge has.
    pub(crate) fn next_number(&self) -> u64 {
        self.numbers.fetch_add(1, Ordering::Relaxed)
    }
}
