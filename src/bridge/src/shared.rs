//! State shared by a bridge's sessions, topics and services.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Weak};

use parking_lot::Mutex;
use ros::bus::{Bus, PeerId, QosProfile, RosVersion, SerializedMessage};
use ros::schema::{MessageType, Registry};
use ros::sizes::InputSizes;
use tokio::sync::watch;

use crate::client_state::BridgeClient;
use crate::fanout::Fanout;
use crate::outbox::CloseReason;
use crate::presence::{self, Presence};
use crate::quality::default_subscription_qos;
use crate::registrations::Registrations;
use crate::republisher::Republisher;
use crate::service_types::ServiceTypes;
use crate::session::SessionCount;
use crate::tf;
use crate::topic_publisher::TopicPublisher;
use crate::topic_requests::TopicRequests;
use crate::{BridgeOptions, Metrics, SessionOptions};

/// Shared state of a bridge.
pub(crate) struct BridgeShared {
    pub(crate) bus: Arc<dyn Bus>,
    pub(crate) registry: Arc<Registry>,
    pub(crate) options: BridgeOptions,
    pub(crate) metrics: Arc<Metrics>,
    pub(crate) service_types: ServiceTypes,
    pub(crate) registrations: Registrations,
    pub(crate) presence: Presence,
    pub(crate) republisher: Republisher,
    /// Sizes of the messages from clients to nodes.
    pub(crate) inputs: InputSizes,
    /// Requests that are made by topic.
    requests: Option<Arc<TopicRequests>>,
    fanouts: Mutex<HashMap<String, Vec<KnownFanout>>>,
    /// Number of topics of nodes with listeners.
    heard: Arc<AtomicUsize>,
    /// Clients' publishers, by topic.
    topic_publishers: Mutex<HashMap<String, Vec<Weak<TopicPublisher>>>>,
    clients: Mutex<ClientRegistry>,
    pub(crate) sessions: watch::Sender<SessionCount>,
    numbers: AtomicU64,
}

/// One of the fanouts of a topic.
struct KnownFanout {
    /// Quality of service requested from publishers; `None` for topics of the bridge itself, which are the same for
    /// all.
    qos: Option<QosProfile>,
    /// Type of the publishers it receives from; `None` for any type, as in ROS 1.
    type_name: Option<String>,
    fanout: Weak<Fanout>,
}

impl KnownFanout {
    fn serves(&self, qos: QosProfile, type_name: Option<&str>) -> bool {
        let hears = |(own, asked): (&str, &str)| own == asked;
        self.qos.is_none_or(|own| own == qos) && self.type_name.as_deref().zip(type_name).is_none_or(hears)
    }
}

/// Counts a topic of nodes that has listeners.
pub(crate) struct NodeTopicGuard(Arc<AtomicUsize>);

impl Drop for NodeTopicGuard {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

#[derive(Default)]
struct ClientRegistry {
    all: Vec<Weak<BridgeClient>>,
    /// Clients that can be resumed, by token.
    resumable: HashMap<String, Arc<BridgeClient>>,
    closed: Option<CloseReason>,
}

impl BridgeShared {
    pub(crate) fn new(bus: Arc<dyn Bus>, registry: Arc<Registry>, options: BridgeOptions) -> Arc<Self> {
        presence::define_types(bus.version(), &registry);
        tf::define_types(bus.version(), &registry);
        let requests = options.pair.as_ref().map(TopicRequests::for_pair);
        Arc::new(Self {
            bus,
            registry,
            options,
            metrics: Arc::default(),
            service_types: ServiceTypes::default(),
            registrations: Registrations::default(),
            presence: Presence::default(),
            republisher: Republisher::default(),
            inputs: InputSizes::default(),
            requests: requests.map(Arc::new),
            fanouts: Mutex::default(),
            heard: Arc::default(),
            topic_publishers: Mutex::default(),
            clients: Mutex::default(),
            sessions: watch::Sender::default(),
            numbers: AtomicU64::new(1),
        })
    }

    /// Refuses clients from now on; returns the existing ones.
    pub(crate) fn close(&self, reason: &CloseReason) -> Vec<Arc<BridgeClient>> {
        let mut clients = self.clients.lock();
        clients.closed.get_or_insert_with(|| reason.clone());
        clients.resumable.clear();
        clients.all.drain(..).filter_map(|client| client.upgrade()).collect()
    }

    pub(crate) fn clients(&self) -> Vec<Arc<BridgeClient>> {
        let clients = self.clients.lock();
        clients.all.iter().filter_map(Weak::upgrade).collect()
    }

    /// Returns the client of a connection: a resumed one, or a new one. Fails after [`close`](Self::close), with the
    /// reason for closing the connection.
    pub(crate) fn client_for(self: &Arc<Self>, options: &SessionOptions) -> Result<Arc<BridgeClient>, CloseReason> {
        let mut clients = self.clients.lock();
        if let Some(reason) = &clients.closed {
            return Err(reason.clone());
        }
        if let Some(token) = &options.resume
            && let Some(client) = clients.resumable.get(token)
        {
            self.metrics.resumed.add(1);
            client.set_grants(options.granted.clone());
            return Ok(client.clone());
        }
        let client = BridgeClient::new(self.clone(), options);
        clients.all.retain(|other| other.strong_count() > 0);
        clients.all.push(Arc::downgrade(&client));
        if let Some(token) = &options.resume {
            clients.resumable.insert(token.clone(), client.clone());
        }
        Ok(client)
    }

    pub(crate) fn forget_client(&self, client: &Arc<BridgeClient>, token: &str) {
        let mut clients = self.clients.lock();
        if clients.resumable.get(token).is_some_and(|known| Arc::ptr_eq(known, client)) {
            clients.resumable.remove(token);
        }
        drop(clients);
        client.end();
    }

    /// Returns the topic's fanout with the default quality of service; starts it if necessary.
    pub(crate) fn fanout(self: &Arc<Self>, topic: &str, message_type: Option<&MessageType>) -> Arc<Fanout> {
        self.fanout_with_qos(topic, message_type, default_subscription_qos(self.options.bus_queue))
    }

    /// Returns the topic's fanout with this quality of service; starts it if necessary.
    pub(crate) fn fanout_with_qos(
        self: &Arc<Self>,
        topic: &str,
        message_type: Option<&MessageType>,
        qos: QosProfile,
    ) -> Arc<Fanout> {
        // In ROS 2 endpoints of different types do not match.
        let type_name = message_type.filter(|found| found.version() == RosVersion::Two);
        let type_name = type_name.map(MessageType::name);
        let mut fanouts = self.fanouts.lock();
        let mut of_topic = fanouts.get(topic).into_iter().flatten();
        let known = of_topic.find(|known| known.serves(qos, type_name));
        if let Some(fanout) = known.and_then(|known| known.fanout.upgrade()) {
            return fanout;
        }
        let (fanout, asked) = match self.own_topic_type(topic) {
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
        let latched = topic_publishers.iter().filter_map(|topic_publisher| topic_publisher.latched_message());
        for message in latched.filter(|_| fanout.keeps_latched()) {
            fanout.deliver(message, true);
        }
        let of_topic = fanouts.entry(topic.to_owned()).or_default();
        of_topic.retain(|known| known.fanout.strong_count() > 0);
        of_topic.push(KnownFanout {
            type_name: type_name.filter(|_| asked.is_some()).map(str::to_owned),
            qos: asked,
            fanout: Arc::downgrade(&fanout),
        });
        // The last owner of a topic_publisher must not drop it under the lock.
        drop(fanouts);
        fanout
    }

    /// Returns the type of a topic that the bridge itself publishes, unless a node of the servant has one of this name.
    fn own_topic_type(&self, topic: &str) -> Option<Arc<MessageType>> {
        let version = self.bus.version();
        let made = || self.republisher.type_name(version, topic);
        let name = presence::type_name(version, topic).or_else(made)?;
        let taken = self.bus.graph().borrow().topics.contains_key(topic);
        self.registry.message(name).ok().filter(|_| !taken)
    }

    /// Returns whether a client listens to a topic of the nodes.
    pub(crate) fn has_node_listeners(&self) -> bool {
        self.heard.load(Ordering::Relaxed) > 0
    }

    /// Counts another topic of the nodes with listeners, until the returned guard is dropped.
    pub(crate) fn count_node_listener(&self) -> NodeTopicGuard {
        self.heard.fetch_add(1, Ordering::Relaxed);
        NodeTopicGuard(Arc::clone(&self.heard))
    }

    /// Publishes the change of connected clients.
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
        if let Some(message) = self.presence.build_message(&fanout.topic, of) {
            fanout.deliver(message, true);
        }
    }

    fn publishers_of(&self, topic: &str) -> Vec<Arc<TopicPublisher>> {
        self.topic_publishers.lock().get(topic).into_iter().flatten().filter_map(Weak::upgrade).collect()
    }

    /// Returns whether the client's publisher with this id still exists.
    pub(crate) fn has_publisher(&self, topic: &str, id: &PeerId) -> bool {
        self.publishers_of(topic).iter().any(|topic_publisher| topic_publisher.id == *id)
    }

    pub(crate) fn add_publisher(&self, topic_publisher: &Arc<TopicPublisher>) {
        self.topic_publishers
            .lock()
            .entry(topic_publisher.topic.clone())
            .or_default()
            .push(Arc::downgrade(topic_publisher));
    }

    /// Removes a topic_publisher that is being dropped, and its latched message.
    pub(crate) fn forget_publisher(&self, topic_publisher: &TopicPublisher) {
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
                fanout.forget_publisher(&topic_publisher.id);
            }
        }
    }

    /// Returns the type of a topic published by clients of this bridge or by the bridge itself, before the graph shows
    /// it.
    pub(crate) fn local_type(&self, topic: &str) -> Option<String> {
        let topic_publishers = self.publishers_of(topic);
        let known = topic_publishers.first().map(|topic_publisher| topic_publisher.message_type.name());
        let version = self.bus.version();
        known
            .or(presence::type_name(version, topic))
            .or_else(|| self.republisher.type_name(version, topic))
            .map(str::to_owned)
    }

    /// Returns the topic's fanouts; none if nobody listens.
    pub(crate) fn live_fanouts(&self, topic: &str) -> Vec<Arc<Fanout>> {
        let fanouts = self.fanouts.lock();
        let of_topic = fanouts.get(topic).into_iter().flatten();
        // None is dropped here: dropping the last reference would take the lock.
        of_topic.filter_map(|known| known.fanout.upgrade()).collect()
    }

    /// Delivers a message of the bridge itself, or of one of its clients, to all listeners; returns false if there are
    /// none.
    pub(crate) fn deliver(&self, topic: &str, message: &SerializedMessage) -> bool {
        let fanouts = self.live_fanouts(topic);
        for fanout in &fanouts {
            fanout.deliver(message.clone(), true);
        }
        !fanouts.is_empty()
    }

    /// Removes a fanout that is gone, or that failed.
    pub(crate) fn forget_fanout(&self, fanout: &Fanout) {
        let mut fanouts = self.fanouts.lock();
        if let Some(of_topic) = fanouts.get_mut(&fanout.topic) {
            of_topic.retain(|known| !std::ptr::eq(known.fanout.as_ptr(), fanout));
            if of_topic.is_empty() {
                fanouts.remove(&fanout.topic);
            }
        }
    }

    /// Returns the tracker of requests if messages on this topic are requests.
    pub(crate) fn requests_on(&self, input: &str) -> Option<Arc<TopicRequests>> {
        let requests = self.requests.as_ref();
        requests.filter(|it| it.is_input(input)).cloned()
    }

    /// Returns the tracker of requests if messages on this topic answer requests.
    pub(crate) fn answers_on(&self, output: &str) -> Option<Arc<TopicRequests>> {
        let requests = self.requests.as_ref();
        requests.filter(|it| it.is_output(output)).cloned()
    }

    /// Returns a number that is unique in this bridge.
    pub(crate) fn next_number(&self) -> u64 {
        self.numbers.fetch_add(1, Ordering::Relaxed)
    }
}
