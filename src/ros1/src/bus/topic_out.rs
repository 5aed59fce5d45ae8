//! A topic that this node publishes.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use bytes::Bytes;
use parking_lot::Mutex;
use ros_bus::ring::DropCount;
use ros_bus::{MatchedPeers, PeerId, QosProfile, WireType};
use tokio::sync::{mpsc, watch};

use super::endpoint_owner::EndpointOwner;
use crate::tcpros::SendQueue;

/// One topic with all its local publishers and all subscribers.
#[derive(Default)]
pub(super) struct TopicOut {
    pub(super) state: Mutex<State>,
    pub(super) matched: watch::Sender<MatchedPeers>,
    pub(super) dropped: DropCount,
}

/// The type, the publishers and the subscribers of a topic.
#[derive(Default)]
pub(super) struct State {
    pub(super) advert: Option<WireType>,
    pub(super) locals: BTreeMap<i32, LocalPublisher>,
    pub(super) subscribers: Vec<Arc<Subscriber>>,
    /// Listening actions of this node.
    pub(super) actions: Vec<PeerId>,
    /// Pending queries for the type that subscribers request, with their ascending numbers.
    pub(super) askers: Vec<(i32, mpsc::UnboundedSender<WireType>)>,
}

/// One local publisher.
pub(super) struct LocalPublisher {
    pub(super) end: EndpointOwner,
    pub(super) qos: QosProfile,
    pub(super) last: Option<Bytes>,
}

/// One connected subscriber.
pub(super) struct Subscriber {
    pub(super) id: i32,
    pub(super) peer: PeerId,
    pub(super) send_queue: SendQueue,
    pub(super) messages: AtomicU64,
    pub(super) bytes: AtomicU64,
    pub(super) closing: watch::Sender<bool>,
}
