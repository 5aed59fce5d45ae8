//! A topic that this node subscribes to.

use std::collections::HashMap;
use std::sync::Arc;

use bytes::Bytes;
use parking_lot::Mutex;
use ros_bus::ring::Ring;
use ros_bus::{MatchedPeers, MessageSender, Offer, PeerId, SerializedMessage, WireType};
use rtps::{DiscoveredGraph, Guid};
use tokio::sync::{Notify, watch};
use tokio::task::AbortHandle;

use super::quality::Quality;
use super::seen::DiscoverySnapshot;

/// Identifies subscriptions that share readers: topic, type name, quality.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct ReaderSetKey {
    pub(super) topic: String,
    /// `*` for any type.
    pub(super) type_name: String,
    pub(super) wish: Quality,
}

/// One topic with all its local subscriptions of one type and quality.
pub(super) struct TopicIn {
    pub(super) key: ReaderSetKey,
    pub(super) depth: usize,
    pub(super) locals: Mutex<TopicSubscribers>,
    /// Known properties of each writer that was discovered or heard.
    pub(super) sources: Mutex<HashMap<Guid, Arc<KnownWriter>>>,
    pub(super) matched: watch::Sender<MatchedPeers>,
    /// Notified when local subscriptions change.
    pub(super) changed: Notify,
    /// Task that maintains the readers.
    pub(super) following: Mutex<Option<AbortHandle>>,
    pub(super) discovered: watch::Receiver<Arc<DiscoveredGraph>>,
    pub(super) seen: watch::Receiver<Arc<DiscoverySnapshot>>,
}

/// The local subscriptions of a topic.
#[derive(Default)]
pub(super) struct TopicSubscribers {
    pub(super) next: u64,
    pub(super) list: Vec<TopicSubscriber>,
    /// Last messages of each transient-local writer, for later local subscriptions.
    pub(super) latched: HashMap<Guid, Ring<SerializedMessage>>,
    /// Messages of writers whose node is not known yet, in order: it will be known in a moment, and a message names its
    /// publisher.
    pub(super) held: Vec<HeldMessage>,
}

/// A message of a writer whose node is not known yet.
pub(super) struct HeldMessage {
    pub(super) writer: Guid,
    /// Properties known when the message arrived.
    pub(super) source: Arc<KnownWriter>,
    pub(super) quality: Quality,
    pub(super) bytes: Bytes,
}

/// One local subscription.
pub(super) struct TopicSubscriber {
    pub(super) id: u64,
    pub(super) sender: MessageSender,
    pub(super) wanted: WireType,
}

/// A writer of the topic.
#[derive(Debug)]
pub(super) struct KnownWriter {
    pub(super) peer: PeerId,
    pub(super) offer: Offer,
    /// Quality of the reader that is meant for the writer.
    pub(super) quality: Quality,
    /// Type name in DDS.
    pub(super) type_name: String,
    /// True once the writer's node is known, as far as it will be.
    pub(super) named: bool,
}
