//! A topic that this node subscribes to.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64};

use parking_lot::Mutex;
use ros_bus::{MatchedPeers, MessageSender, Offer, PeerId, SerializedMessage, WireType};
use tokio::sync::watch;
use tokio::task::AbortHandle;

use super::endpoint_owner::EndpointOwner;

/// One topic with all its local subscriptions and publishers.
pub(super) struct TopicIn {
    pub(super) name: String,
    pub(super) locals: Mutex<LocalSubscribers>,
    pub(super) links: Mutex<PublisherLinks>,
    /// Publishers that have not left.
    pub(super) matched: watch::Sender<MatchedPeers>,
}

/// One connection per publisher, by its address.
#[derive(Default)]
pub(super) struct PublisherLinks {
    pub(super) by_uri: BTreeMap<String, Arc<PublisherLink>>,
    pub(super) ended: bool,
}

/// The local subscriptions of a topic.
#[derive(Default)]
pub(super) struct LocalSubscribers {
    pub(super) list: Vec<LocalSubscriber>,
    /// Last message of each latching publisher, by its address, for later local subscriptions.
    pub(super) latched: HashMap<String, SerializedMessage>,
}

/// One local subscription.
pub(super) struct LocalSubscriber {
    pub(super) id: i32,
    pub(super) end: EndpointOwner,
    pub(super) sender: MessageSender,
    pub(super) wanted: WireType,
}

/// One publisher, as seen by the topic.
pub(super) struct PublisherLink {
    pub(super) id: i32,
    pub(super) uri: String,
    pub(super) listed: watch::Sender<bool>,
    pub(super) task: Mutex<Option<AbortHandle>>,
    /// Offer in the publisher's header, from the first connection on.
    pub(super) offer: Mutex<Option<Offer>>,
    /// The publisher's id, from the first connection until it has left.
    pub(super) publisher: Mutex<Option<PeerId>>,
    pub(super) connected: AtomicBool,
    pub(super) messages: AtomicU64,
    pub(super) bytes: AtomicU64,
}
