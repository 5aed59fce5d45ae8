//! What a bridge's sessions, topics and services have in common.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Weak};

use parking_lot::Mutex;
use ros::bus::{Bus, Message, PeerId, Qos, RosVersion};
use ros::schema::{MessageType, Registry};
use ros::sizes::Inputs;
use tokio::sync::watch;

use crate::bridge::SessionCount;
use crate::client::Client;
use crate::fanout::Fanout;
use crate::presence::{self, Presence};
use crate::quality::all_there_is;
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
    fanouts: Mutex<HashMap<String, Vec<Known>>>,
    /// Topics of nodes that somebody listens to.
    heard: Arc<AtomicUsize>,
    /// What clients publish on, by topic.
    topic_publishers: Mutex<HashMap<String, Vec<Weak<TopicPublisher>>>>,
    clients: Mutex<Clients>,
    pub(crate) sessions: watch::Sender<SessionCount>,
    numbers: AtomicU64,
}

/// One of the fanouts of a topic.
struct Known {
    /// What it asks of the topic's publishers; none of a topic of the bridge itself, which is the same for all.
    qos: Option<Qos>,
    /// The type whose publishers it hears; none where it hears those of all, as in ROS 1.
    type_name: Option<String>,
    fanout: Weak<Fanout>,
}

impl Known {
    fn serves(&self, qos: Qos, type_name: Option<&str>) -> bool {
        let hears = |(own, asked): (&str, &str)| own == asked;
        self.qos.is_none_or(|own| own == qos)
            && self.type_name.as_deref().zip(type_name).is_none_or(hears)
    }
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
        presence::define(bus.version(), &registry);
        tf::define(bus.version(), &registry);
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

    /// The topic's fanout for who takes all there is; begun if it is not there.
    pub(crate) fn fanout(
        self: &Arc<Self>,
        topic: &str,
        message_type: Option<&MessageType>,
    ) -> Arc<Fanout> {
        self.fanout_of(topic, message_type, all_there_is(self.options.bus_queue))
    }

    /// The same for who asks this of its publishers.
    pub(crate) fn fanout_of(
        self: &Arc<Self>,
        topic: &str,
        message_type: Option<&MessageType>,
        qos: Qos,
    ) -> Arc<Fanout> {
        // In ROS 2 ends of different types do not meet.
        let type_name = message_type.filter(|found| found.version() == RosVersion::Two);
        let type_name = type_name.map(MessageType::name);
        let mut fanouts = self.fanouts.lock();
        let mut of_topic = fanouts.get(topic).into_iter().flatten();
        let known = of_topic.find(|known| known.serves(qos, type_name));
        if let Some(fanout) = known.and_then(|known| known.fanout.upgrade()) {
            return fanout;
        }
        let (fanout, asked) = match self.own_topic(topic) {
            Some(own) => {
                let fanout = Fanout::internal(self, topic);
                if presence::type_name(self.bus.version(), topic).is_some() {
                    self.report_presence_to(&fanout, &own);
                }
                (fanout, None)
            }
            None => (Fanout::start(self, topic, message_type, qos), Some(qos)),
        };
        let topic_publishers = self.publishers_of(topic);
        let latched = topic_publishers
            .iter()
            .filter_map(|topic_publisher| topic_publisher.latched());
        for message in latched.filter(|_| fanout.keeps()) {
            fanout.deliver(message, true);
        }
        let of_topic = fanouts.entry(topic.to_owned()).or_default();
        of_topic.retain(|known| known.fanout.strong_count() > 0);
        of_topic.push(Known {
            type_name: type_name.filter(|_| asked.is_some()).map(str::to_owned),
            qos: asked,
            fanout: Arc::downgrade(&fanout),
        });
        // The last owner of an topic_publisher must not drop it under the lock.
        drop(fanouts);
        fanout
    }

    /// The type of a topic that the bridge itself publishes, unless a node of the servant has one of this name.
    fn own_topic(&self, topic: &str) -> Option<Arc<MessageType>> {
        let version = self.bus.version();
        let made = || self.republisher.type_name(version, topic);
        let name = presence::type_name(version, topic).or_else(made)?;
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
            let mut live = self.live_fanouts(topic).into_iter();
            let fanout = live.find(|fanout| fanout.is_internal());
            let name = presence::type_name(self.bus.version(), topic);
            let own = name.and_then(|name| self.registry.message(name).ok());
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
        if topic_publisher.offer.latch {
            for fanout in self.live_fanouts(&topic_publisher.topic) {
                fanout.forget(&topic_publisher.id);
            }
        }
    }

    /// What clients of this bridge publish on a topic, known before the graph shows it.
    pub(crate) fn local_type(&self, topic: &str) -> Option<String> {
        let topic_publishers = self.publishers_of(topic);
        let known = topic_publishers
            .first()
            .map(|topic_publisher| topic_publisher.message_type.name());
        let version = self.bus.version();
        known
            .or(presence::type_name(version, topic))
            .or_else(|| self.republisher.type_name(version, topic))
            .map(str::to_owned)
    }

    /// The topic's fanouts; none if nobody listens.
    pub(crate) fn live_fanouts(&self, topic: &str) -> Vec<Arc<Fanout>> {
        let fanouts = self.fanouts.lock();
        let of_topic = fanouts.get(topic).into_iter().flatten();
        // None is dropped here: its last owner would forget it, under the lock.
        of_topic
            .filter_map(|known| known.fanout.upgrade())
            .collect()
    }

    /// Hands a message of the bridge's own, or of one of its clients, to all who listen; false where nobody does.
    pub(crate) fn deliver(&self, topic: &str, message: &Message) -> bool {
        let fanouts = self.live_fanouts(topic);
        for fanout in &fanouts {
            fanout.deliver(message.clone(), true);
        }
        !fanouts.is_empty()
    }

    /// Forgets a fanout that is gone, or that will never carry anything.
    pub(crate) fn forget_fanout(&self, fanout: &Fanout) {
        let mut fanouts = self.fanouts.lock();
        if let Some(of_topic) = fanouts.get_mut(&fanout.topic) {
            of_topic.retain(|known| !std::ptr::eq(known.fanout.as_ptr(), fanout));
            if of_topic.is_empty() {
                fanouts.remove(&fanout.topic);
            }
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
