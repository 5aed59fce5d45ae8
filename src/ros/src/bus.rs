//! The seam behind which a ROS version hides: ROS 1 (Master, TCPROS) or ROS 2 (DDS).
//!
//! Messages cross it serialized, reference-counted and never copied per subscriber. What only some ROS versions have is an
//! extension ([`GlobalParameters`], [`NodeParameters`], [`Lending`], [`Hearing`]) that a bus offers, or not.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use tokio::sync::watch;

use crate::ring::{DropCount, Held};
use crate::schema::ActionDef;

mod actions;
mod error;
mod graph;
mod lending;
mod matched;
mod node_parameters;
mod parameters;
mod qos;
mod queue;
mod types;

pub use actions::{ActionClient, ActionHandler, ActionServer, GoalEnd, GoalEvents, Outcome};
pub use error::{BusError, CallFate};
pub use graph::{ActionNodes, Graph, NodeEnds, NodeNames, ParameterUse, TopicNodes};
pub use lending::{Lender, Lending, Lent, ServiceProvider};
pub use matched::{Matched, Offer, Peer, PeerId, Refusal, reaches};
pub use node_parameters::{
    DoubleRange, IntegerRange, NodeParameters, ParameterDescription, ParameterEvent,
    ParameterEvents, ParameterKind, ParameterNames,
};
pub use parameters::{GlobalParameters, ParamChange, ParamChanges, ParamValue};
pub(crate) use parameters::{ParamTeller, changes_within};
pub use qos::{Durability, Liveliness, Qos, Reliability};
pub use queue::{MessageReceiver, MessageSender, message_queue};
pub use types::{Digest, ServiceType, WireFormat, WireType};

/// The generations of ROS.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum RosVersion {
    /// Master, TCPROS, actionlib.
    One,
    /// DDS.
    Two,
}

impl RosVersion {
    /// 1 or 2.
    pub fn number(self) -> u8 {
        match self {
            Self::One => 1,
            Self::Two => 2,
        }
    }
}

/// One serialized message from one publisher.
#[derive(Debug, Clone)]
pub struct Message {
    /// The message without any length prefix.
    pub bytes: Bytes,
    /// What the publisher said it is.
    pub wire_type: Arc<WireType>,
    /// Who published it.
    pub publisher: PeerId,
    /// Whether the publisher is transient-local: a newcomer must be given the last one per publisher.
    pub latching: bool,
}

impl Held for Message {
    fn held(&self) -> usize {
        self.bytes.len()
    }
}

/// A live subscription; dropping it unsubscribes.
pub struct Subscription {
    /// Messages in the order received per publisher. What this bus itself published is not among them.
    pub messages: MessageReceiver,
    /// Messages dropped so far because `messages` was full.
    pub dropped: Arc<DropCount>,
    /// The publishers, now and later.
    pub matched: watch::Receiver<Matched>,
    /// Keeps the subscription alive.
    pub guard: Box<dyn Send + Sync>,
}

/// A topic that this side publishes; dropping it unadvertises, after what is queued was sent.
pub trait Publisher: Send + Sync {
    /// Sends one serialized message (without length prefix) to every subscriber; never blocks.
    fn publish(&self, bytes: Bytes);
    /// The subscribers, now and later.
    fn matched(&self) -> watch::Receiver<Matched>;
    /// Messages dropped so far because a subscriber of this topic was too slow, summed over subscribers.
    fn dropped(&self) -> u64 {
        0
    }
}

/// Answers the calls to one service that this side serves.
#[async_trait]
pub trait ServiceHandler: Send + Sync + 'static {
    /// Takes a serialized request, gives a serialized response or the reason why not.
    async fn call(&self, request: Bytes, caller: &str) -> Result<Bytes, String>;

    /// What answers a caller that expects the type with this digest, for a handler that serves several types (its own
    /// is `*`); itself by default.
    fn for_type(&self, _digest: &Digest) -> Option<Arc<dyn ServiceHandler>> {
        None
    }
}

/// Knows whom publishers send to, as they say themselves. A publisher may answer a subscriber before it sends to it: what it
/// publishes in between, the subscriber does not hear. ROS 1 offers it; where matching is mutual, none is needed.
#[async_trait]
pub trait Hearing: Send + Sync {
    /// The connections over which a topic's publishers send to this side: each publisher with its own number of it. One
    /// that has just been connected to is not among them for a moment.
    async fn heard_over(&self, topic: &str) -> Result<BTreeSet<PeerId>, BusError>;
}

impl dyn Bus {
    /// A global parameter, or a whole namespace of them.
    pub async fn parameter(&self, key: &str) -> Result<ParamValue, BusError> {
        self.parameters()?.get(key).await
    }
}

/// One servant's (or one robot's) ROS, reached from outside. Names are resolved, absolute ones (`/image`).
#[async_trait]
pub trait Bus: Send + Sync + 'static {
    /// Which ROS it is.
    fn version(&self) -> RosVersion;
    /// The name of the distribution (`noetic`).
    async fn distribution(&self) -> String;
    /// The name under which this side is a node; empty where it is none.
    fn node(&self) -> &str {
        ""
    }
    /// Whose nodes' the ends of this side are told to be, where it stands for several (ROS 2); what is not named here is its own node's.
    fn stands_for(&self, _nodes: BTreeMap<String, NodeNames>) {}
    /// The graph now and as it changes.
    fn graph(&self) -> watch::Receiver<Arc<Graph>>;
    /// Subscribes to messages of type `of` ([`WireType::any`] where it does not matter); publishers that come later are
    /// connected as they register.
    async fn subscribe(
        &self,
        topic: &str,
        of: WireType,
        qos: Qos,
    ) -> Result<Subscription, BusError>;
    /// Advertises. With [`Durability::TransientLocal`] newcomers are given the last message of this publisher. Each
    /// advertisement keeps its own, so whoever relays several such publishers of one topic advertises once for each.
    async fn advertise(
        &self,
        topic: &str,
        of: WireType,
        qos: Qos,
    ) -> Result<Box<dyn Publisher>, BusError>;
    /// Calls a service once; the connection is kept for the next call.
    async fn call(
        &self,
        service: &str,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, BusError> {
        self.call_typed(service, &Digest::any(), request, timeout)
            .await
    }
    /// The same, unless the server's type has meanwhile another digest than the request was serialized by.
    async fn call_typed(
        &self,
        service: &str,
        digest: &Digest,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, BusError>;
    /// The type of a service, without calling it.
    async fn service_type(&self, service: &str) -> Result<ServiceType, BusError>;
    /// The type of a topic as its publishers have it, or, where there are none, its subscribers; without subscribing.
    async fn topic_type(&self, topic: &str) -> Result<WireType, BusError>;
    /// Serves a service until the returned guard is dropped.
    async fn serve(
        &self,
        service: &str,
        service_type: ServiceType,
        handler: Arc<dyn ServiceHandler>,
    ) -> Result<Box<dyn Send + Sync>, BusError>;
    /// An action to send goals to; it is opened in the background.
    fn action_client(
        &self,
        action: &str,
        of: &Arc<ActionDef>,
    ) -> Result<Box<dyn ActionClient>, BusError>;
    /// Serves an action until what is returned is dropped; it is opened in the background.
    fn serve_action(
        &self,
        action: &str,
        of: &Arc<ActionDef>,
        handler: Arc<dyn ActionHandler>,
    ) -> Result<Box<dyn ActionServer>, BusError>;
    /// The parameters that all nodes share.
    fn parameters(&self) -> Result<&dyn GlobalParameters, BusError> {
        Err(BusError::NotOffered("global parameters"))
    }
    /// The parameters that each node has of its own.
    fn node_parameters(&self) -> Result<&dyn NodeParameters, BusError> {
        Err(BusError::NotOffered("parameters of nodes"))
    }
    /// Services of other ROS systems.
    fn lending(&self) -> Result<&dyn Lending, BusError> {
        Err(BusError::NotOffered("services of another system"))
    }
    /// Whom publishers send to; none where [`Subscription::matched`] says all there is to know.
    fn hearing(&self) -> Option<&dyn Hearing> {
        None
    }
    /// Becomes the reason when someone asked this node to end. The bus itself goes on: whether to obey is its owner's
    /// decision. None where nobody can ask.
    fn shutdown_requested(&self) -> Option<watch::Receiver<Option<String>>> {
        None
    }
    /// A process of this system is known to have ended: a bus that finds out by and by which nodes are gone looks at once. Nothing
    /// to do where they are not found out about in this way.
    fn process_ended(&self) {}
    /// Takes back everything registered and closes all connections. What is still held (subscriptions,
    /// publishers, guards) becomes inert.
    async fn close(&self) {}
}
