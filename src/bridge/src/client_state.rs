//! State of a client: its subscriptions, advertisements, services and actions.

use std::collections::{HashMap, HashSet};
use std::sync::atomic::{AtomicU8, AtomicUsize};
use std::sync::{Arc, OnceLock, Weak};

use budget::Budget;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{FailureReason, QosProfile};
use ros::schema::{ActionDef, MessageType, ServiceDef};
use rosbridge::{Compression, Format, Id};
use tokio::sync::{oneshot, watch};
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::ClientGrants;
use crate::fanout::ListenerGuard;
use crate::outbox::{Outbox, TopicKey};
use crate::quality::PublisherOffer;
use crate::shared::BridgeShared;
use crate::topic_publisher::TopicPublisher;
use crate::topic_queue::Subscriptions;

/// A client of the bridge.
pub(crate) struct BridgeClient {
    pub(crate) shared: Arc<BridgeShared>,
    pub(crate) name: String,
    pub(crate) outbox: Arc<Outbox>,
    /// Counts the data queued for the client.
    pub(crate) budget: Budget,
    /// Grants of the client.
    pub(crate) granted: Mutex<ClientGrants>,
    pub(crate) hears_clients: bool,
    pub(crate) resumable: bool,
    pub(crate) level: AtomicU8,
    /// Number of calls and goals in progress.
    pub(crate) under_way: AtomicUsize,
    /// Bytes of their arguments.
    pub(crate) under_way_bytes: AtomicUsize,
    pub(crate) ended: CancellationToken,
    pub(crate) subscriptions: Mutex<ClientSubscriptions>,
    pub(crate) topic_publishers: Mutex<TopicPublishers>,
    pub(crate) services: Mutex<ClientServices>,
    pub(crate) actions: Mutex<Actions>,
    /// Topics, services and actions (`topic /scan`) about which the client was told that `seq` is dropped.
    pub(crate) seq_reported: Mutex<HashSet<String>>,
}

/// Destination of an answer: the interaction and the format.
#[derive(Debug, Clone)]
pub(crate) struct ReplyTarget {
    pub(crate) id: Option<Id<'static>>,
    pub(crate) format: Format,
}

/// Topics of a client, by absolute name.
#[derive(Default)]
pub(crate) struct TopicPublishers {
    pub(crate) open: HashMap<String, AdvertisedTopic>,
    pub(crate) untyped: HashMap<String, Vec<Untyped>>,
    /// Topics for which the client was told why nothing can be published.
    pub(crate) told: HashSet<String>,
}

/// A topic that is published until it has been unadvertised as often as it was advertised.
pub(crate) struct AdvertisedTopic {
    pub(crate) topic_publisher: Arc<TopicPublisher>,
    /// Ids of its advertisements; empty if it was only published on.
    pub(crate) ids: HashSet<Option<Id<'static>>>,
}

/// A message whose topic's type is being looked up.
pub(crate) struct Untyped {
    pub(crate) format: Format,
    pub(crate) payload: Bytes,
    pub(crate) compression: Compression,
    pub(crate) offer: PublisherOffer,
    pub(crate) reply: ReplyTarget,
}

/// Services of a client, and the calls it has not answered yet.
#[derive(Default)]
pub(crate) struct ClientServices {
    pub(crate) served: HashMap<String, ServedService>,
    pub(crate) requests: HashMap<String, PendingCall>,
    /// Number of calls that the client has been given, of all its services.
    pub(crate) requested: u64,
}

/// A service of a client.
pub(crate) struct ServedService {
    pub(crate) number: u64,
    /// Registration state; closed without having been true if the registration failed.
    pub(crate) registered: watch::Receiver<bool>,
    /// Ends the task that holds the registration.
    pub(crate) _stop: DropGuard,
}

/// A call that the client has not answered yet.
pub(crate) struct PendingCall {
    pub(crate) service: String,
    pub(crate) def: Arc<ServiceDef>,
    pub(crate) answer: oneshot::Sender<Result<Bytes, FailureReason>>,
}

/// Subscriptions of a client, by the topic name that it uses.
pub(crate) type ClientSubscriptions = HashMap<Arc<str>, TopicSubscription>;

/// The subscriptions of a client to a topic.
pub(crate) struct TopicSubscription {
    pub(crate) key: TopicKey,
    pub(crate) subscriptions: Subscriptions,
    /// Quality of service that each of them requests from publishers.
    pub(crate) asked: HashMap<Option<Id<'static>>, QosProfile>,
    /// Type of the topic, if it was known.
    pub(crate) expected: Option<Arc<MessageType>>,
    pub(crate) listening: ListenerGuard,
    pub(crate) listener: Arc<TopicListener>,
}

/// Puts messages of a topic into the client's queue.
pub(crate) struct TopicListener {
    pub(crate) outbox: Arc<Outbox>,
    pub(crate) key: TopicKey,
    pub(crate) hears_clients: bool,
    pub(crate) client: Weak<BridgeClient>,
    pub(crate) topic: Arc<str>,
    /// Type that the client asked for, if any.
    pub(crate) wanted: Option<String>,
    pub(crate) id: Option<Id<'static>>,
    pub(crate) format: Format,
}

/// The actions that a client uses and serves.
#[derive(Default)]
pub(crate) struct Actions {
    /// Actions it sends goals to, by name.
    pub(crate) used: HashMap<String, Arc<ActionClient>>,
    /// Goals in progress, by the server's id.
    pub(crate) goals: HashMap<String, ActiveGoal>,
    /// Actions it serves, by name.
    pub(crate) served: HashMap<String, Arc<ActionServer>>,
}

/// A goal that can be cancelled.
pub(crate) struct ActiveGoal {
    /// Name of the action.
    pub(crate) action: String,
    /// Id used by the client, for cancelling.
    pub(crate) id: Option<Id<'static>>,
    /// Cancelled before it was sent.
    pub(crate) recalled: CancellationToken,
}

/// An action that a client sends goals to.
pub(crate) struct ActionClient {
    pub(crate) def: Arc<ActionDef>,
    pub(crate) bus: Box<dyn ros::bus::ActionClient>,
}

/// An action that a client serves.
pub(crate) struct ActionServer {
    pub(crate) name: String,
    /// Name and type as the client wrote them.
    pub(crate) written: String,
    pub(crate) written_type: String,
    pub(crate) def: Arc<ActionDef>,
    pub(crate) compression: Compression,
    /// Goals in progress: from the client's ids to the bus's.
    pub(crate) goals: Mutex<HashMap<String, String>>,
    /// Set once, right after construction: goals are sent to the server itself.
    pub(crate) bus: OnceLock<Box<dyn ros::bus::ActionServer>>,
    pub(crate) client: Weak<BridgeClient>,
}
