//! Topics that this node publishes: a writer for each advertisement.

use std::collections::HashMap;
use std::sync::Arc;

use bytes::Bytes;
use rtps::{EndpointData, EndpointQos, Ends};
use tokio::sync::watch;
use tokio::task::AbortHandle;

use super::bus::Inner;
use super::ends::WriterEnd;
use super::quality;
use super::seen::{self, Seen};
use super::{names, show, topic_type};
use crate::bus::{BusError, Matched, Peer, PeerId, Publisher, Qos, Refusal, WireType};

/// What this node advertises, by topic: the type, and how many do.
pub(super) type Adverts = HashMap<String, (Arc<WireType>, usize)>;

/// Advertises with a writer of its own.
pub(super) async fn advertise(
    bus: &Arc<Inner>,
    name: &str,
    of: WireType,
    qos: Qos,
) -> Result<Box<dyn Publisher>, BusError> {
    let of = match of.name.as_str() {
        // DDS knows no topic without a type; whoever does not know it means that of the others.
        "*" => topic_type::find(bus, name).await?,
        _ => of,
    };
    let topic = names::topic(name, &of)?;
    let of = claim(bus, name, of)?;
    let endpoint = quality::offered(&qos);
    let writer = WriterEnd::open(bus, &topic, endpoint);
    let matched = watch::Sender::default();
    let handle = matched.subscribe();
    let following = Following {
        bus: Arc::clone(bus),
        name: name.to_owned(),
        topic: topic.name,
        of: Arc::clone(&of),
        qos: endpoint,
        ends: writer.ends(),
        matched,
        told: HashMap::new(),
    };
    Ok(Box::new(Handle {
        bus: Arc::clone(bus),
        name: name.to_owned(),
        writer,
        matched: handle,
        following: bus.spawn(following.run()),
    }))
}

/// All advertisements of a topic have one type.
fn claim(bus: &Inner, name: &str, of: WireType) -> Result<Arc<WireType>, BusError> {
    let mut adverts = bus.adverts.lock();
    let (before, count) = adverts
        .entry(name.to_owned())
        .or_insert_with(|| (Arc::new(of.clone()), 0));
    if before.name != of.name || !before.agrees(&of) {
        return Err(BusError::TypeMismatch {
            what: format!("advertisement of {name}"),
            theirs: before.to_string(),
            ours: of.to_string(),
        });
    }
    *count += 1;
    Ok(Arc::clone(before))
}

/// Looks who listens.
struct Following {
    bus: Arc<Inner>,
    name: String,
    /// As DDS has it.
    topic: String,
    of: Arc<WireType>,
    qos: EndpointQos,
    ends: watch::Receiver<Arc<Ends>>,
    matched: watch::Sender<Matched>,
    /// Refusals that were logged.
    told: HashMap<PeerId, String>,
}

impl Following {
    async fn run(mut self) {
        let mut seen = self.bus.seen.subscribe();
        loop {
            let now = Arc::clone(&seen.borrow_and_update());
            let matched = self.look(&now);
            show::refusals(&mut self.told, &self.name, &matched);
            show::matched(&self.matched, matched);
            let changed = tokio::select! {
                changed = self.ends.changed() => changed,
                changed = seen.changed() => changed,
            };
            if changed.is_err() {
                return;
            }
        }
    }

    fn look(&mut self, seen: &Seen) -> Matched {
        let ends = Arc::clone(&self.ends.borrow_and_update());
        let mut now = Matched::default();
        // Whose the others are will be told in a moment.
        let named = |reader: &Arc<EndpointData>| seen.is_named(reader.guid);
        for reader in ends.matched.iter().filter(|it| named(it)) {
            let peer = seen.peer(reader.guid);
            let theirs = seen::wire_type(reader);
            if theirs.agrees(&self.of) {
                now.peers.push(Peer {
                    id: peer,
                    connected: ends.confirmed.contains(&reader.guid),
                    offer: None,
                });
            } else {
                let why = show::other_type(&theirs, &self.of);
                now.refused.push(Refusal { peer, why });
            }
        }
        let refused = ends.refused.iter().filter(|(reader, _)| named(reader));
        now.refused.extend(refused.map(|(reader, why)| Refusal {
            peer: seen.peer(reader.guid),
            why: quality::refusal(why, &self.qos, &reader.qos),
        }));
        // Ends of a type with another name do not meet at all.
        for reader in seen.readers(&self.topic).iter().filter(|it| named(it)) {
            let theirs = seen::wire_type(reader);
            if theirs.name != self.of.name {
                let why = show::other_type(&theirs, &self.of);
                let peer = seen.peer(reader.guid);
                now.refused.push(Refusal { peer, why });
            }
        }
        now
    }
}

/// One local publisher.
struct Handle {
    bus: Arc<Inner>,
    name: String,
    /// Whoever has not got all of it yet still gets it when this is dropped.
    writer: WriterEnd,
    matched: watch::Receiver<Matched>,
    following: AbortHandle,
}

impl Publisher for Handle {
    fn publish(&self, bytes: Bytes) {
        self.writer.write(bytes);
    }

    fn matched(&self) -> watch::Receiver<Matched> {
        self.matched.clone()
    }

    fn dropped(&self) -> u64 {
        self.writer.dropped()
    }
}

impl Drop for Handle {
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
