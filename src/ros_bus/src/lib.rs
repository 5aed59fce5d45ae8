//! The interface that hides the ROS version from the rest of the code: ROS 1 (Master, TCPROS) or ROS 2 (DDS). Here are
//! its types, the queues and sockets that every implementation needs, and no protocol.
//!
//! Messages cross it serialized and reference-counted; they are never copied per subscriber. Features that only some
//! ROS versions have are extension traits ([`GlobalParameters`], [`NodeParameters`], [`Lending`], [`PublisherReports`])
//! that a bus may or may not offer.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use ros_message::schema::ActionDef;
use tokio::sync::watch;

use crate::ring::{DropCount, RingItem};

mod action_ends;
mod actions;
mod error;
mod failure_reason;
mod graph;
pub mod hidden_names;
mod identity;
mod inquiries;
mod join;
mod lending;
mod matched_endpoints;
pub mod net;
mod network;
mod node_parameters;
pub mod parameter_names;
mod parameters;
mod qos;
mod queue;
mod retry;
pub mod ring;
mod succession;
pub mod turns;
mod types;

pub use action_ends::{ActionEndpoint, action_endpoints, split_action_endpoint};
pub use actions::{ActionClient, ActionHandler, ActionServer, GoalEnd, GoalError, GoalEvents, GoalOutcome};
pub use error::{BusError, CallFate};
pub use failure_reason::FailureReason;
pub use graph::{ActionNodes, Graph, NodeEntities, NodeNames, ParameterUse, TopicNodes};
pub use identity::{Naming, NodeIdentity, NodeRename, enclave_for, linked_node};
pub use inquiries::TypeInquiries;
pub use join::{JoinOptions, MAX_MESSAGE, MESSAGE_TIMEOUT};
pub use lending::{Lender, Lending, LentService, ServiceProvider};
pub use matched_endpoints::{IncompatiblePeer, MatchedPeers, Offer, PeerId, TopicPeer, wait_for_connected};
pub use network::{DiscoveryNetwork, DiscoveryServer, InterfaceAddress, InterfaceSelection};
pub use node_parameters::{
    DoubleRange, IntegerRange, NodeParameters, ParameterDescription, ParameterEvent, ParameterEvents, ParameterKind,
    ParameterNames,
};
pub use parameters::{
    GlobalParameters, ParamChange, ParamChangeReceiver, ParamChangeSender, ParamValue, param_change_channel,
};
pub use qos::{QosDurability, QosLiveliness, QosProfile, QosReliability};
pub use queue::{MessageReceiver, MessageSender, message_queue};
pub use retry::Retry;
pub use ros_message::RosVersion;
pub use succession::{ParticipantPrefix, Succession};
pub use types::{Digest, ServiceType, WireFormat, WireType};

/// One serialized message from one publisher.
#[derive(Debug, Clone)]
pub struct SerializedMessage {
    /// The serialized message, without a length prefix.
    pub bytes: Bytes,
    /// Type declared by the publisher.
    pub wire_type: Arc<WireType>,
    /// The publisher.
    pub publisher: PeerId,
    /// True if the publisher is transient-local: a late subscriber must be given its last message.
    pub latching: bool,
}

impl RingItem for SerializedMessage {
    fn memory_size(&self) -> usize {
        self.bytes.len()
    }
}

/// A live subscription; dropping it unsubscribes.
pub struct Subscription {
    /// Received messages, in order per publisher. Messages that this bus itself published are not included.
    pub messages: MessageReceiver,
    /// Messages dropped so far because `messages` was full.
    pub dropped: Arc<DropCount>,
    /// The matched publishers, updated as they change.
    pub matched: watch::Receiver<MatchedPeers>,
    /// Keeps the subscription alive.
    pub guard: Box<dyn Send + Sync>,
}

/// A topic that this bus publishes. Dropping it unadvertises the topic after the queued messages have been sent.
pub trait Publisher: Send + Sync {
    /// Sends one serialized message (without length prefix) to every subscriber; never blocks.
    fn publish(&self, bytes: Bytes);
    /// Returns the matched subscribers, updated as they change.
    fn matched_subscribers(&self) -> watch::Receiver<MatchedPeers>;
    /// Sets how many of its last messages a transient-local publisher gives to late subscribers, at most its depth;
    /// without this, as many as its depth. In ROS 1 it is always the last one.
    fn set_kept(&self, messages: usize) {
        let _ = messages;
    }
    /// Returns the number of messages dropped so far because a subscriber of this topic was too slow, summed over
    /// subscribers.
    fn dropped_count(&self) -> u64 {
        0
    }
}

/// Answers the calls to one service that this bus serves.
#[async_trait]
pub trait ServiceHandler: Send + Sync + 'static {
    /// Handles a serialized request; returns the serialized response or the reason for the failure.
    async fn call(&self, request: Bytes, caller: &str) -> Result<Bytes, FailureReason>;

    /// Returns the handler for a caller that expects the type with this digest, for handlers that serve several types
    /// (whose own digest is `*`). `None`, the default, means this handler.
    fn for_type(&self, _digest: &Digest) -> Option<Arc<dyn ServiceHandler>> {
        None
    }
}

/// Reports to whom publishers say they send. A publisher may answer a subscriber before it starts sending to it:
/// messages it publishes in between never reach the subscriber. Offered by ROS 1; not needed where matching is mutual.
#[async_trait]
pub trait PublisherReports: Send + Sync {
    /// Returns the connections over which a topic's publishers send to this node, each as the publisher with its own
    /// number for the connection. A connection that was just made may be missing for a moment.
    async fn reported_connections(&self, topic: &str) -> Result<BTreeSet<PeerId>, BusError>;
}

impl dyn Bus {
    /// Returns the value of a global parameter or of a whole namespace.
    pub async fn parameter(&self, key: &str) -> Result<ParamValue, BusError> {
        self.parameters()?.get(key).await
    }
}

/// One ROS system (a servant's or a robot's), accessed from outside. Names are resolved, that is absolute (`/image`).
#[async_trait]
pub trait Bus: Send + Sync + 'static {
    /// Returns the ROS version.
    fn version(&self) -> RosVersion;
    /// Returns the name of the distribution (`noetic`).
    async fn distribution(&self) -> String;
    /// Returns the name under which this bus is a node; empty if it is none.
    fn node(&self) -> &str {
        ""
    }
    /// Sets the nodes to which the endpoints of this bus are attributed, if it represents several (ROS 2). Endpoints
    /// that are not listed belong to the bus's own node.
    fn set_represented_nodes(&self, _nodes: BTreeMap<String, NodeNames>) {}
    /// Returns the graph, updated as it changes.
    fn graph(&self) -> watch::Receiver<Arc<Graph>>;
    /// Subscribes to messages of type `of` ([`WireType::any`] for any type). Publishers that appear later are connected
    /// as they register.
    async fn subscribe(&self, topic: &str, of: WireType, qos: QosProfile) -> Result<Subscription, BusError>;
    /// Advertises a topic. With [`QosDurability::TransientLocal`] late subscribers are given the last message of this
    /// publisher. Each advertisement keeps its own last message, so a relay for several such publishers of one topic
    /// advertises once for each.
    async fn advertise(&self, topic: &str, of: WireType, qos: QosProfile) -> Result<Box<dyn Publisher>, BusError>;
    /// Calls a service once; the connection is kept for the next call.
    async fn call(&self, service: &str, request: Bytes, timeout: Duration) -> Result<Bytes, BusError> {
        self.call_typed(service, &Digest::any(), request, timeout).await
    }
    /// Like [`call`](Self::call), but fails if the server's type no longer has the digest that the request was
    /// serialized with.
    async fn call_typed(
        &self,
        service: &str,
        digest: &Digest,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, BusError>;
    /// Returns the type of a service, without calling it.
    async fn service_type(&self, service: &str) -> Result<ServiceType, BusError>;
    /// Returns the type of a topic as declared by its publishers or, without any, by its subscribers; does not
    /// subscribe.
    async fn topic_type(&self, topic: &str) -> Result<WireType, BusError>;
    /// Returns that type, and whether the publisher keeps its last message for late subscribers as far as that is known
    /// without a subscription: in ROS 1 only the publisher itself announces it.
    async fn topic_offer(&self, topic: &str) -> Result<Offer, BusError> {
        let wire_type = Arc::new(self.topic_type(topic).await?);
        Ok(Offer { wire_type, latching: false, kept: None })
    }
    /// Serves a service until the returned guard is dropped.
    async fn serve(
        &self,
        service: &str,
        service_type: ServiceType,
        handler: Arc<dyn ServiceHandler>,
    ) -> Result<Box<dyn Send + Sync>, BusError>;
    /// Creates a client of an action; its topics or services are opened in the background.
    fn action_client(&self, action: &str, of: &Arc<ActionDef>) -> Result<Box<dyn ActionClient>, BusError>;
    /// Serves an action until the returned value is dropped; it is opened in the background.
    fn serve_action(
        &self,
        action: &str,
        of: &Arc<ActionDef>,
        handler: Arc<dyn ActionHandler>,
    ) -> Result<Box<dyn ActionServer>, BusError>;
    /// Returns the parameters that all nodes share.
    fn parameters(&self) -> Result<&dyn GlobalParameters, BusError> {
        Err(BusError::NotOffered("global parameters"))
    }
    /// Returns access to the parameters of individual nodes.
    fn node_parameters(&self) -> Result<&dyn NodeParameters, BusError> {
        Err(BusError::NotOffered("parameters of nodes"))
    }
    /// Returns the interface for lending services of other ROS systems.
    fn lending(&self) -> Result<&dyn Lending, BusError> {
        Err(BusError::NotOffered("services of another system"))
    }
    /// Returns the publishers' reports; `None` where [`Subscription::matched`] is complete.
    fn publisher_reports(&self) -> Option<&dyn PublisherReports> {
        None
    }
    /// Returns the reason for shutdown, set once another node has asked this node to shut down. The bus keeps running:
    /// its owner decides whether to comply. `None` where no node can ask.
    fn shutdown_requested(&self) -> Option<watch::Receiver<Option<String>>> {
        None
    }
    /// Notifies the bus that a process of this system has exited. A bus that detects vanished nodes by polling polls at
    /// once; otherwise there is nothing to do.
    fn on_process_exit(&self) {}
    /// Takes back everything registered and closes all connections. Subscriptions, publishers and guards that still
    /// exist become inert.
    async fn close(&self) {}
}
