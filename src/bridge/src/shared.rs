//! What a bridge's sessions, topics and services have in common.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Weak};

use parking_lot::Mutex;
use ros::bus::{Bus, PeerId};
use ros::schema::{MessageType, Registry};
use ros::sizes::Inputs;
use tokio::sync::watch;

use crate::bridge::SessionCount;
use crate::client::Client;
use crate::fanout::Fanout;
use crate::presence::{self, Presence};
use crate::registrations::Registrations;
use crate::service_types::ServiceTypes;
use crate::tf::{self, Republisher};
use crate::topic_publisher::TopicPublisher;
use crate::topic_requests::TopicRequests;
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
    /// How large what clients send to nodes is.
    pub(crate) inputs: Inputs,
    /// Requests that are made by topic.
    requests: Option<Arc<TopicRequests>>,
    fanouts: Mutex<HashMap<String, Weak<Fanout>>>,
    /// Topics of nodes that somebody listens to.
    heard: Arc<AtomicUsize>,
    /// What clients publish on, by topic.
    topic_publishers: Mutex<HashMap<String, Vec<Weak<TopicPublisher>>>>,
    clients: Mutex<Clients>,
    pub(crate) sessions: watch::Sender<SessionCount>,
    numbers: AtomicU64,
}

/// Counts a topic of the nodes that is listened to.
pub(crate) struct Heard(Arc<AtomicUsize>);

impl Drop for Heard {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
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
        let requests = options.pair.as_ref().map(TopicRequests::of);
        Arc::new(Self {
            bus,
            registry,
            options,
            metrics: Arc::default(),
            service_types: ServiceTypes::default(),
            registrations: Registrations::default(),
            presence: Presence::default(),
            republisher: Republisher::default(),
            inputs: Inputs::default(),
            requests: requests.map(Arc::new),
            fanouts: Mutex::default(),
            heard: Arc::default(),
            topic_publishers: Mutex::default(),
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

    pub(crate) fn clients(&self) -> Vec<Arc<Client>> {
        let clients = self.clients.lock();
        clients.all.iter().filter_map(Weak::upgrade).collect()
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
            client.grant(options.granted.clone());
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

    /// The topic's fanout; begun if it is not there.
    pub(crate) fn fanout(
        self: &Arc<Self>,
        topic: &str,
        message_type: Option<&MessageType>,
    ) -> Arc<Fanout> {
        let mut fanouts = self.fanouts.lock();
        if let Some(fanout) = fanouts.get(topic).and_then(Weak::upgrade) {
            return fanout;
        }
        let fanout = match self.own_topic(topic) {
            Some(own) => {
                let fanout = Fanout::internal(self, topic);
                if presence::type_name(topic).is_some() {
                    self.report_presence_to(&fanout, &own);
                }
                fanout
            }
            None => Fanout::start(self, topic, message_type),
        };
        let topic_publishers = self.publishers_of(topic);
        for message in topic_publishers
            .iter()
            .filter_map(|topic_publisher| topic_publisher.latched())
        {
            fanout.deliver(message, true);
        }
        fanouts.insert(topic.to_owned(), Arc::downgrade(&fanout));
        // The last owner of an topic_publisher must not drop it under the lock.
        drop(fanouts);
        fanout
    }

    /// The type of a topic that the bridge itself publishes, unless a node of the servant has one of this name.
    fn own_topic(&self, topic: &str) -> Option<Arc<MessageType>> {
        let name = presence::type_name(topic).or_else(|| self.republisher.type_name(topic))?;
        let taken = self.bus.graph().borrow().topics.contains_key(topic);
        self.registry.message(name).ok().filter(|_| !taken)
    }

    /// Whether a client listens to a topic of the nodes.
    pub(crate) fn hears_nodes(&self) -> bool {
        self.heard.load(Ordering::Relaxed) > 0
    }

    /// One more topic of the nodes is listened to, until what is given is dropped.
    pub(crate) fn hear_nodes(&self) -> Heard {
        self.heard.fetch_add(1, Ordering::Relaxed);
        Heard(Arc::clone(&self.heard))
    }

    /// Tells who listens that somebody has come or gone.
    pub(crate) fn report_presence(&self) {
        for topic in presence::TOPICS {
            let fanout = self
                .live_fanout(topic)
                .filter(|fanout| fanout.is_internal());
            let own = presence::type_name(topic).and_then(|name| self.registry.message(name).ok());
            if let (Some(fanout), Some(own)) = (fanout, own) {
                self.report_presence_to(&fanout, &own);
            }
        }
    }

    fn report_presence_to(&self, fanout: &Fanout, of: &MessageType) {
        if let Some(message) = self.presence.message(&fanout.topic, of) {
            fanout.deliver(message, true);
        }
    }

    fn publishers_of(&self, topic: &str) -> Vec<Arc<TopicPublisher>> {
        self.topic_publishers
            .lock()
            .get(topic)
            .into_iter()
            .flatten()
            .filter_map(Weak::upgrade)
            .collect()
    }

    /// Whether the client that published so still does.
    pub(crate) fn has_outlet(&self, topic: &str, id: &PeerId) -> bool {
        self.publishers_of(topic)
            .iter()
            .any(|topic_publisher| topic_publisher.id == *id)
    }

    pub(crate) fn add_outlet(&self, topic_publisher: &Arc<TopicPublisher>) {
        self.topic_publishers
            .lock()
            .entry(topic_publisher.topic.clone())
            .or_default()
            .push(Arc::downgrade(topic_publisher));
    }

    /// Forgets an topic_publisher that is being dropped, and what it latched.
    pub(crate) fn forget_outlet(&self, topic_publisher: &TopicPublisher) {
        let mut topic_publishers = self.topic_publishers.lock();
        if let Some(others) = topic_publishers.get_mut(&topic_publisher.topic) {
            others.retain(|other| other.strong_count() > 0);
            if others.is_empty() {
                topic_publishers.remove(&topic_publisher.topic);
            }
        }
        drop(topic_publishers);
        if topic_publisher.latch
            && let Some(fanout) = self.live_fanout(&topic_publisher.topic)
        {
            fanout.forget(&topic_publisher.id);
        }
    }

    /// What clients of this bridge publish on a topic, known before the graph shows it.
    pub(crate) fn local_type(&self, topic: &str) -> Option<String> {
        let topic_publishers = self.publishers_of(topic);
        let known = topic_publishers
            .first()
            .map(|topic_publisher| topic_publisher.message_type.name());
        known
            .or(presence::type_name(topic))
            .or_else(|| self.republisher.type_name(topic))
            .map(str::to_owned)
    }

    /// The topic's fanout, if anybody listens.
    pub(crate) fn live_fanout(&self, topic: &str) -> Option<Arc<Fanout>> {
        self.fanouts.lock().get(topic).and_then(Weak::upgrade)
    }

    /// Forgets a fanout that is gone, or that will never carry anything.
    pub(crate) fn forget_fanout(&self, fanout: &Fanout) {
        let mut fanouts = self.fanouts.lock();
        if fanouts
            .get(&fanout.topic)
            .is_some_and(|known| std::ptr::eq(known.as_ptr(), fanout))
        {
            fanouts.remove(&fanout.topic);
        }
    }

    /// The requests that messages on this topic are, if any.
    pub(crate) fn requests_on(&self, input: &str) -> Option<Arc<TopicRequests>> {
        let requests = self.requests.as_ref();
        requests.filter(|it| it.is_input(input)).cloned()
    }

    /// The requests that messages on this topic answer, if any.
    pub(crate) fn answers_on(&self, output: &str) -> Option<Arc<TopicRequests>> {
        let requests = self.requests.as_ref();
        requests.filter(|it| it.is_output(output)).cloned()
    }

    /// A number that nothing else of this bridge has.
    pub(crate) fn next_number(&self) -> u64 {
        self.numbers.fetch_add(1, Ordering::Relaxed)
    }
}
