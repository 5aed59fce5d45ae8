//! Topics that this node publishes: one writer for each advertisement.

use std::collections::HashMap;
use std::sync::Arc;

use bytes::Bytes;
use ros_bus::{BusError, IncompatiblePeer, MatchedPeers, Offer, PeerId, Publisher, QosProfile, TopicPeer, WireType};
use rtps::{EndpointData, EndpointMatches, EndpointQos};
use tokio::sync::watch;
use tokio::task::AbortHandle;

use super::ends::WriterEnd;
use super::quality;
use super::seen::{self, DiscoverySnapshot};
use super::state::Ros2BusState;
use super::{names, show, topic_type};

/// Advertises a topic with a writer of its own.
pub(super) async fn advertise(
    bus: &Arc<Ros2BusState>,
    name: &str,
    of: WireType,
    qos: QosProfile,
) -> Result<Box<dyn Publisher>, BusError> {
    let of = match of.name.as_str() {
        // DDS has no topic without a type; an unspecified type means that of the other endpoints.
        "*" => topic_type::find(bus, name).await?,
        _ => of,
    };
    let topic = names::topic(name, &of)?;
    let of = claim(bus, name, of)?;
    let endpoint = quality::writer_qos(&qos);
    let writer = WriterEnd::open(bus, &topic, endpoint);
    let matched = watch::Sender::default();
    let handle = matched.subscribe();
    let following = SubscriberWatcher {
        bus: Arc::clone(bus),
        name: name.to_owned(),
        topic: topic.name,
        of: Arc::clone(&of),
        qos: endpoint,
        ends: writer.ends(),
        matched,
        told: HashMap::new(),
    };
    Ok(Box::new(WriterHandle {
        bus: Arc::clone(bus),
        name: name.to_owned(),
        writer,
        matched: handle,
        following: bus.spawn(following.run()),
    }))
}

/// Checks that all advertisements of a topic have one type, and counts this one.
fn claim(bus: &Ros2BusState, name: &str, of: WireType) -> Result<Arc<WireType>, BusError> {
    let mut adverts = bus.adverts.lock();
    let (before, count) = adverts.entry(name.to_owned()).or_insert_with(|| (Arc::new(of.clone()), 0));
    if before.name != of.name || !before.is_compatible_with(&of) {
        return Err(BusError::TypeMismatch {
            what: format!("advertisement of {name}"),
            theirs: before.to_string(),
            ours: of.to_string(),
        });
    }
    *count += 1;
    Ok(Arc::clone(before))
}

/// Tracks the subscribers of a writer.
struct SubscriberWatcher {
    bus: Arc<Ros2BusState>,
    name: String,
    /// Name in DDS.
    topic: String,
    of: Arc<WireType>,
    qos: EndpointQos,
    ends: watch::Receiver<Arc<EndpointMatches>>,
    matched: watch::Sender<MatchedPeers>,
    /// Incompatible peers that were logged.
    told: HashMap<PeerId, String>,
}

impl SubscriberWatcher {
    async fn run(mut self) {
        let mut seen = self.bus.seen.subscribe();
        loop {
            let now = Arc::clone(&seen.borrow_and_update());
            let matched = self.find_subscribers(&now);
            show::log_incompatible(&mut self.told, &self.name, &matched);
            show::publish_matched(&self.matched, matched);
            let changed = tokio::select! {
                changed = self.ends.changed() => changed,
                changed = seen.changed() => changed,
            };
            if changed.is_err() {
                return;
            }
        }
    }

    fn find_subscribers(&mut self, seen: &DiscoverySnapshot) -> MatchedPeers {
        let ends = Arc::clone(&self.ends.borrow_and_update());
        let mut now = MatchedPeers::default();
        // The node of the others will be known in a moment.
        let named = |reader: &Arc<EndpointData>| seen.is_named(reader.guid);
        for reader in ends.matched.iter().filter(|it| named(it)) {
            let peer = seen.peer(reader.guid);
            let theirs = seen::wire_type(reader);
            if theirs.is_compatible_with(&self.of) {
                let connected = ends.confirmed.contains(&reader.guid);
                let latching = quality::is_latching(reader);
                let offer = Offer { wire_type: Arc::new(theirs), latching, kept: None };
                now.peers.push(TopicPeer { id: peer, connected, offer: Some(offer) });
            } else {
                let why = show::type_mismatch_text(&theirs, &self.of);
                now.refused.push(IncompatiblePeer { peer, why });
            }
        }
        let refused = ends.refused.iter().filter(|(reader, _)| named(reader));
        now.refused.extend(refused.map(|(reader, why)| IncompatiblePeer {
            peer: seen.peer(reader.guid),
            why: quality::mismatch_text(why, &self.qos, &reader.qos),
        }));
        // Endpoints with another type name do not match at all.
        for reader in seen.readers(&self.topic).iter().filter(|it| named(it)) {
            let theirs = seen::wire_type(reader);
            if theirs.name != self.of.name {
                let why = show::type_mismatch_text(&theirs, &self.of);
                let peer = seen.peer(reader.guid);
                now.refused.push(IncompatiblePeer { peer, why });
            }
        }
        now
    }
}

/// One local publisher.
struct WriterHandle {
    bus: Arc<Ros2BusState>,
    name: String,
    /// When this is dropped, readers that have not received everything still get the rest.
    writer: WriterEnd,
    matched: watch::Receiver<MatchedPeers>,
    following: AbortHandle,
}

impl Publisher for WriterHandle {
    fn publish(&self, bytes: Bytes) {
        self.writer.write(bytes);
    }

    fn matched_subscribers(&self) -> watch::Receiver<MatchedPeers> {
        self.matched.clone()
    }

    fn set_kept(&self, messages: usize) {
        self.writer.set_kept(messages);
    }

    fn dropped_count(&self) -> u64 {
        self.writer.dropped_count()
    }
}

impl Drop for WriterHandle {
    fn drop(&mut self) {
        self.following.abort();
        let mut adverts = self.bus.adverts.lock();
        if let Some((_, count)) = adverts.get_mut(&self.name) {
            *count -= 1;
            if *count == 0 {
                adverts.remove(&self.name);
            }
        }
    }
}
