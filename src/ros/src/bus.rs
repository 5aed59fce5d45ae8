//! The seam behind which a ROS version hides: ROS 1 (Master, TCPROS) now, ROS 2 (DDS) next.
//!
//! Messages cross it serialized, reference-counted and never copied per subscriber.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use tokio::sync::{mpsc, watch};

mod queue;

pub use queue::{MessageReceiver, MessageSender, message_queue};

/// What nodes have registered, seen at one moment.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Graph {
    /// Grows by one with every change.
    pub generation: u64,
    /// Topic → its type and the nodes at both ends.
    pub topics: BTreeMap<String, TopicNodes>,
    /// Service → the node that serves it.
    pub services: BTreeMap<String, String>,
    /// Node → its XML-RPC address (ROS 1) or GUID (ROS 2).
    pub nodes: BTreeMap<String, String>,
    /// Every parameter key that a node asked for or wrote, with the nodes that did.
    pub parameters: BTreeMap<String, ParameterUse>,
    /// Services that nodes looked for when there were none, with those nodes. Told by our own Master only.
    pub sought: BTreeMap<String, Vec<String>>,
}

/// The ends of one topic.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TopicNodes {
    /// `package/Type`, or `*` where nobody has said yet.
    pub type_name: String,
    /// Names of publishing nodes.
    pub publishers: Vec<String>,
    /// Names of subscribing nodes.
    pub subscribers: Vec<String>,
}

/// Who touched a parameter.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ParameterUse {
    /// Nodes that asked for it (`getParam`, `hasParam`, `searchParam`, `subscribeParam`).
    pub read_by: Vec<String>,
    /// Nodes that set it.
    pub written_by: Vec<String>,
}

/// A type as a peer announced it on the wire.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct WireType {
    /// `package/Type`.
    pub name: String,
    /// MD5 of the definition (ROS 1) or the type hash (ROS 2), lower-case hex; `*` accepts all.
    pub md5: String,
    /// The full text with dependencies, where the peer sent one (ROS 1 publishers do), else empty.
    pub definition: String,
}

/// One serialized message from one publisher.
#[derive(Debug, Clone)]
pub struct Message {
    /// The message without any length prefix.
    pub bytes: Bytes,
    /// What the publisher said it is.
    pub wire_type: Arc<WireType>,
    /// Name of the publishing node.
    pub publisher: Arc<str>,
    /// Whether the publisher's connection is latching: a newcomer must be given the last one per publisher.
    pub latching: bool,
}

/// How to subscribe.
#[derive(Debug, Clone)]
pub struct SubscribeOptions {
    /// `package/Type` where the caller knows it; the publisher's otherwise.
    pub wire_type: Option<WireType>,
    /// Messages kept while the receiver is busy (0 counts as 1); the oldest is dropped (and counted) beyond.
    pub queue: usize,
}

/// A live subscription; dropping it unsubscribes.
pub struct Subscription {
    /// Messages in the order received per publisher. What this bus itself published is not among them.
    pub messages: MessageReceiver,
    /// Messages dropped so far because `messages` was full.
    pub dropped: Arc<AtomicU64>,
    /// How many publishers are connected now, and later.
    pub publishers: watch::Receiver<usize>,
    /// Names of the publishers that have not left: who is connected, or was and has not yet been tried again. Who is
    /// missing here has sent all that it had.
    pub present: watch::Receiver<BTreeSet<Arc<str>>>,
    /// Keeps the subscription alive.
    pub guard: Box<dyn Send + Sync>,
}

/// How to advertise.
#[derive(Debug, Clone)]
pub struct AdvertiseOptions {
    /// Name, md5 and full definition of what will be published.
    pub wire_type: WireType,
    /// Newcomers are given the last message of this publisher. Each advertisement keeps its own, so whoever
    /// relays several latching publishers of one topic advertises once for each.
    pub latch: bool,
    /// Messages kept per slow subscriber (0 counts as 1); the oldest is dropped beyond.
    pub queue: usize,
}

/// A topic that this side publishes; dropping it unadvertises, after what is queued was sent.
pub trait Publisher: Send + Sync {
    /// Sends one serialized message (without length prefix) to every subscriber; never blocks.
    fn publish(&self, bytes: Bytes);
    /// How many subscribers are connected now, and later.
    fn subscribers(&self) -> watch::Receiver<usize>;
    /// Messages dropped so far because a subscriber of this topic was too slow, summed over subscribers.
    fn dropped(&self) -> u64 {
        0
    }
    /// Names of the connected nodes, in the order in which they came; empty where they cannot be told.
    fn subscriber_names(&self) -> Vec<String> {
        Vec::new()
    }
}

/// One changed parameter: its key, and its value unless it was deleted.
pub type ParamChange = (String, Option<ParamValue>);

/// Parameters as they change: key and value, or no value where one was deleted.
pub type ParamChanges = mpsc::UnboundedReceiver<ParamChange>;

/// Answers the calls to one service that this side serves.
#[async_trait]
pub trait ServiceHandler: Send + Sync + 'static {
    /// Takes a serialized request, gives a serialized response or the reason why not.
    async fn call(&self, request: Bytes, caller: &str) -> Result<Bytes, String>;

    /// What answers a caller that expects the type with this md5, for a handler that serves several types (its own
    /// md5 is `*`); itself by default.
    fn for_md5(&self, _md5: &str) -> Option<Arc<dyn ServiceHandler>> {
        None
    }
}

/// A service's types as its server announced them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServiceType {
    /// `package/Type`.
    pub name: String,
    /// MD5 of request and response together.
    pub md5: String,
}

/// A service's server, as it told of itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServiceProvider {
    /// The node that serves it.
    pub node: String,
    /// What it serves.
    pub service_type: ServiceType,
    /// How it [labels](crate::ros1::Ros1Bus::set_label) itself.
    pub label: Option<String>,
}

/// A service of another ROS system.
#[derive(Clone)]
pub struct Lent {
    /// As it is there.
    pub service_type: ServiceType,
    /// Passes calls on.
    pub handler: Arc<dyn ServiceHandler>,
    /// Becomes true, or loses its sender, when it can be had no more: connections end then, between two calls.
    pub gone: watch::Receiver<bool>,
}

/// Lends nodes the services of another ROS system.
#[async_trait]
pub trait Lender: Send + Sync + 'static {
    /// `node` looks for a service that nobody serves here, and waits for the answer. Later lookups ask again.
    async fn find(&self, service: &str, node: &str) -> Option<Lent>;
}

/// A ROS parameter value. NaN equals NaN: whoever looks for what has changed would never be done otherwise.
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
#[serde(untagged)]
pub enum ParamValue {
    /// `true` or `false`.
    Bool(bool),
    /// 32-bit on the XML-RPC wire; wider values are refused there.
    Int(i64),
    /// A double.
    Double(f64),
    /// UTF-8 text.
    String(String),
    /// Bytes: XML-RPC's base64. In JSON it is written as base64 text, and read back as text.
    #[serde(serialize_with = "as_base64", skip_deserializing)]
    Binary(Vec<u8>),
    /// Nothing: a Master may hold it, ROS knows no such value. It is never sent.
    #[serde(skip_deserializing)]
    Nil,
    /// A list.
    List(Vec<ParamValue>),
    /// A dictionary.
    Map(BTreeMap<String, ParamValue>),
}

fn as_base64<S: serde::Serializer>(bytes: &[u8], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(&base64_simd::STANDARD.encode_to_string(bytes))
}

impl PartialEq for ParamValue {
    fn eq(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Bool(a), Self::Bool(b)) => a == b,
            (Self::Int(a), Self::Int(b)) => a == b,
            (Self::Double(a), Self::Double(b)) => a == b || (a.is_nan() && b.is_nan()),
            (Self::String(a), Self::String(b)) => a == b,
            (Self::Binary(a), Self::Binary(b)) => a == b,
            (Self::Nil, Self::Nil) => true,
            (Self::List(a), Self::List(b)) => a == b,
            (Self::Map(a), Self::Map(b)) => a == b,
            _ => false,
        }
    }
}

/// What can go wrong on a bus.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// Nobody serves it.
    #[error("service {0} has no server")]
    NoService(String),
    /// Nobody publishes or subscribes to it.
    #[error("topic {0} has neither publisher nor subscriber")]
    NoTopic(String),
    /// This side serves it already.
    #[error("service {0} is already served by this side; drop the earlier guard first")]
    AlreadyServed(String),
    /// Both sides mean different definitions.
    #[error("{what} is {theirs} there and {ours} here")]
    TypeMismatch {
        /// Topic or service.
        what: String,
        /// `name md5` as the peer has it.
        theirs: String,
        /// `name md5` as we have it.
        ours: String,
    },
    /// The server said no.
    #[error("service {service} failed: {reason}")]
    CallFailed {
        /// The service's name.
        service: String,
        /// What the server said.
        reason: String,
    },
    /// No answer in time.
    #[error("{what} did not answer within {after:?}")]
    Timeout {
        /// Topic, service or Master.
        what: String,
        /// How long was waited.
        after: Duration,
    },
    /// The Master refused.
    #[error("the ROS Master refused {call}: {reason}")]
    Master {
        /// Method called.
        call: String,
        /// Its status message.
        reason: String,
    },
    /// No such parameter.
    #[error("parameter {0} is not set")]
    NoParam(String),
    /// A name that ROS does not allow.
    #[error("{0} is not a valid ROS name")]
    BadName(String),
    /// A value that does not fit the wire.
    #[error("parameter {key} cannot be sent: {reason}")]
    BadParam {
        /// The parameter's key.
        key: String,
        /// What is wrong with its value.
        reason: String,
    },
    /// The bus was closed.
    #[error("the connection to this ROS system was closed")]
    Closed,
    /// The connection failed.
    #[error("{what}: {source}")]
    Io {
        /// What was being done.
        what: String,
        /// Why it failed.
        source: std::io::Error,
    },
    /// The peer does not speak the protocol.
    #[error("{what} broke the protocol: {reason}")]
    Protocol {
        /// Topic, service or node that sent it.
        what: String,
        /// In which way it breaks the protocol.
        reason: String,
    },
}

/// One servant's (or one robot's) ROS, reached from outside. Names are resolved, absolute ones (`/image`).
#[async_trait]
pub trait Bus: Send + Sync + 'static {
    /// The name under which this side is a node; empty where it is none.
    fn node(&self) -> &str {
        ""
    }
    /// The graph now and as it changes.
    fn graph(&self) -> watch::Receiver<Arc<Graph>>;
    /// Subscribes; publishers that come later are connected as they register.
    async fn subscribe(
        &self,
        topic: &str,
        options: SubscribeOptions,
    ) -> Result<Subscription, BusError>;
    /// Advertises.
    async fn advertise(
        &self,
        topic: &str,
        options: AdvertiseOptions,
    ) -> Result<Box<dyn Publisher>, BusError>;
    /// Calls a service once; the connection is kept for the next call.
    async fn call(
        &self,
        service: &str,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, BusError>;
    /// The same, unless the server's type has meanwhile another md5 than the request was serialized by.
    async fn call_typed(
        &self,
        service: &str,
        md5: &str,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, BusError>;
    /// Asks a server for its type without calling it (ROS 1: `probe=1`).
    async fn service_type(&self, service: &str) -> Result<ServiceType, BusError>;
    /// The same, and who it is.
    async fn service_provider(&self, service: &str) -> Result<ServiceProvider, BusError>;
    /// From now on nodes find the lender's services, too. What is served here always comes first, and what is lent
    /// is not registered: it can be looked up, called and waited for. One lender at a time; needs our own Master.
    async fn lend(&self, lender: Arc<dyn Lender>) -> Result<(), BusError>;
    /// Asks a topic's peers for their type without subscribing: a publisher's header, or, for a topic that is
    /// only subscribed to, what the subscribers announce when connected to.
    async fn topic_type(&self, topic: &str) -> Result<WireType, BusError>;
    /// The connections over which a topic's publishers send to this side, as they say themselves: each publisher with
    /// its own number of it. One that has just been connected to is not among them for a moment, and what it publishes
    /// then is not heard.
    async fn heard_over(&self, topic: &str) -> Result<BTreeSet<(String, i32)>, BusError>;
    /// Serves a service until the returned guard is dropped.
    async fn serve(
        &self,
        service: &str,
        service_type: ServiceType,
        handler: Arc<dyn ServiceHandler>,
    ) -> Result<Box<dyn Send + Sync>, BusError>;
    /// Reads a parameter or a whole namespace (`/` for all).
    async fn get_param(&self, key: &str) -> Result<ParamValue, BusError>;
    /// Sets a parameter; a map replaces the namespace below `key`.
    async fn set_param(&self, key: &str, value: ParamValue) -> Result<(), BusError>;
    /// Removes a parameter.
    async fn delete_param(&self, key: &str) -> Result<(), BusError>;
    /// Whether it is set.
    async fn has_param(&self, key: &str) -> Result<bool, BusError>;
    /// Searches upwards from `namespace`, as ROS does.
    async fn search_param(&self, namespace: &str, key: &str) -> Result<Option<String>, BusError>;
    /// All keys that are set.
    async fn param_names(&self) -> Result<Vec<String>, BusError>;
    /// Every change of any parameter from now on, those made by this side included. One watcher at a time: another
    /// takes the place of the first.
    async fn watch_params(&self) -> Result<ParamChanges, BusError>;
    /// Takes back everything registered and closes all connections. What is still held (subscriptions,
    /// publishers, guards) becomes inert.
    async fn close(&self) {}
}
