//! A participant without sockets and clock: datagrams and the time go in, datagrams and samples come out.
//!
//! ```text
//!   receive ─▶ discovering (who is there) ─▶ matching (which endpoints communicate)
//!        │                                        │
//!        ├─▶ readers ─▶ deliveries                ▼
//!        └─▶ writers ─▶ SendRequests ─▶ paths: one per address ─▶ transmit
//! ```

#![forbid(unsafe_code)]

mod discovering;
mod ends;
mod incoming;
mod matching;
mod networks;
mod outgoing;
mod participants;
mod paths;
mod ports;
mod predecessors;
mod servers;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::io::IoSlice;
use std::net::{SocketAddr, SocketAddrV4};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;
use tokio::sync::watch;

pub(crate) use self::discovering::BUILTIN;
use self::paths::DestinationQueue;
use self::predecessors::Predecessors;
use self::servers::{DiscoverySource, Repetition};
use crate::discovery::ParticipantData;
use crate::locator::Ports;
use crate::network::InterfaceSet;
use crate::qos::{DurabilityKind, EndpointQos, HistoryKind};
use crate::reader::{ReaderLimits, ReaderState};
use crate::shared::{DiscoveredGraph, DiscoveryServer, EndpointMatches, ReceivedSample, Sink};
use crate::time::WireTime;
use crate::wire::DatagramWriter;
use crate::writer::{CacheChange, SendRequests, WriterState};
use crate::{EntityId, Guid, GuidPrefix, SequenceNumber, VendorId};

/// A datagram to be sent, in parts, so that a fragment is not copied.
#[derive(Debug, Clone)]
pub(crate) struct Datagram {
    pub to: SocketAddr,
    pub head: Vec<u8>,
    pub body: Bytes,
    pub tail: &'static [u8],
}

impl Datagram {
    fn from_writer(to: SocketAddr, writer: DatagramWriter) -> Self {
        Self { to, head: writer.finish(), body: Bytes::new(), tail: &[] }
    }

    /// Returns the parts in the order in which they are sent.
    pub fn parts(&self) -> [IoSlice<'_>; 3] {
        [&self.head, &self.body[..], self.tail].map(IoSlice::new)
    }
}

/// Another participant.
#[derive(Debug)]
struct RemoteParticipant {
    data: Arc<ParticipantData>,
    /// Address for discovery data.
    discovery: SocketAddr,
    /// Default address of its endpoints.
    user: SocketAddr,
    /// Source of its discovery.
    via: DiscoverySource,
    heard: Instant,
    /// Time at which it was first pinged since it was last heard.
    asked: Option<Instant>,
}

/// A local writer.
struct LocalWriter {
    state: WriterState,
    ends: watch::Sender<Arc<EndpointMatches>>,
    /// The writer was dropped and is kept until this time for readers that have not received everything.
    leaves: Option<Instant>,
}

/// A local reader; built-in readers have no sink.
struct LocalReader {
    state: ReaderState,
    ends: watch::Sender<Arc<EndpointMatches>>,
    sink: Option<Arc<dyn Sink>>,
}

/// Configuration of an engine.
pub(crate) struct Settings {
    pub own: ParticipantData,
    pub ports: Ports,
    pub bounds: ReaderLimits,
    /// Addresses to which announcements are sent in addition to known participants.
    pub announce_to: Vec<SocketAddr>,
    /// Discovery servers; if there are any, announcements are sent only to them.
    pub servers: Vec<DiscoveryServer>,
    pub network: InterfaceSet,
    /// Neither sends announcements nor listens to others.
    pub alone: bool,
    /// Participants that ended without a farewell and had the same lease duration.
    pub predecessors: Vec<GuidPrefix>,
}

/// The protocol engine of one participant.
pub(crate) struct Engine {
    own: ParticipantData,
    ports: Ports,
    bounds: ReaderLimits,
    announce_to: Vec<SocketAddr>,
    servers: Vec<DiscoveryServer>,
    announcements: i64,
    announce_at: Instant,
    announce_pause: Duration,
    network: InterfaceSet,
    alone: bool,
    predecessors: Predecessors,
    /// Ports of the domain on this machine that were bound at the last check.
    bound: BTreeSet<SocketAddrV4>,
    remotes: HashMap<GuidPrefix, RemoteParticipant>,
    discovered: DiscoveredGraph,
    discovered_changed: bool,
    told: watch::Sender<Arc<DiscoveredGraph>>,
    writers: HashMap<EntityId, LocalWriter>,
    readers: HashMap<EntityId, LocalReader>,
    /// Sequence numbers of the samples that announce local endpoints, and of those that dispose of them.
    announced: HashMap<EntityId, SequenceNumber>,
    withdrawn: VecDeque<(EntityId, SequenceNumber)>,
    /// Local endpoints that are announced to servers again, because a match is not confirmed.
    repetitions: HashMap<EntityId, Repetition>,
    next_entity: u32,
    /// Endpoints whose [`EndpointMatches`] have changed.
    changed_ends: BTreeSet<EntityId>,
    control: VecDeque<Datagram>,
    paths: BTreeMap<SocketAddr, DestinationQueue>,
    next_path: Option<SocketAddr>,
    deliveries: Vec<(Arc<dyn Sink>, ReceivedSample)>,
    tick_at: Instant,
    closed: bool,
    /// A warning about too many participants or endpoints was logged.
    crowded: bool,
}

impl Engine {
    pub fn new(now: Instant, settings: Settings) -> Self {
        let Settings { own, ports, bounds, announce_to, servers, network, alone, predecessors } = settings;
        let mut engine = Self {
            predecessors: Predecessors::new(now, predecessors, own.lease),
            own,
            ports,
            bounds,
            announce_to,
            servers,
            announcements: 0,
            announce_at: now,
            announce_pause: discovering::FIRST_PAUSE,
            network,
            alone,
            bound: BTreeSet::new(),
            remotes: HashMap::new(),
            discovered: DiscoveredGraph::default(),
            discovered_changed: false,
            told: watch::Sender::new(Arc::default()),
            writers: HashMap::new(),
            readers: HashMap::new(),
            announced: HashMap::new(),
            withdrawn: VecDeque::new(),
            repetitions: HashMap::new(),
            next_entity: 1,
            changed_ends: BTreeSet::new(),
            control: VecDeque::new(),
            paths: BTreeMap::new(),
            next_path: None,
            deliveries: Vec::new(),
            tick_at: now,
            closed: false,
            crowded: false,
        };
        engine.add_builtin_endpoints();
        if engine.is_client() {
            engine.add_server_endpoints(now);
        }
        engine
    }

    pub fn guid(&self) -> Guid {
        Guid::new(self.own.prefix, EntityId::PARTICIPANT)
    }

    pub fn watch_discovered(&self) -> watch::Receiver<Arc<DiscoveredGraph>> {
        self.told.subscribe()
    }

    /// Returns the time at which [`tick`](Self::tick) is to be called.
    pub fn tick_at(&self) -> Instant {
        self.tick_at
    }

    fn wake(&mut self, at: Instant) {
        self.tick_at = self.tick_at.min(at);
    }

    /// Returns the samples for sinks since the last call. They are delivered while the engine is not locked.
    pub fn take_deliveries(&mut self) -> Vec<(Arc<dyn Sink>, ReceivedSample)> {
        std::mem::take(&mut self.deliveries)
    }

    /// Performs the operations that are due.
    pub fn tick(&mut self, now: Instant) {
        let mut again = self.tick_discovery(now);
        let mut answers = Vec::new();
        let mut announcements = Vec::new();
        for (entity, reader) in &mut self.readers {
            let mut out = Vec::new();
            again = again.min(reader.state.tick(now, &mut answers, &mut out).unwrap_or(again));
            match &reader.sink {
                Some(sink) => self.deliveries.extend(out.into_iter().map(|sample| (Arc::clone(sink), sample))),
                None => announcements.extend(out.into_iter().map(|sample| (*entity, sample))),
            }
        }
        for (entity, sample) in announcements {
            self.on_announcement(now, entity, &sample);
        }
        for answer in answers {
            self.send_ack(answer);
        }
        let mut all = Vec::new();
        for (entity, writer) in &mut self.writers {
            let mut wanted = SendRequests::default();
            again = again.min(writer.state.tick(now, &mut wanted).unwrap_or(again));
            all.push((*entity, wanted));
        }
        for (entity, wanted) in all {
            self.enqueue(entity, wanted);
        }
        self.tick_at = again;
        self.remove_finished_writers(now);
        self.publish_changes();
    }

    /// Announces the departure; datagrams queued now are the last ones.
    pub fn close(&mut self, now: Instant) {
        if !std::mem::replace(&mut self.closed, true) {
            self.announce_departure(now);
        }
    }

    /// Returns whether all readers have received everything written to them.
    pub fn is_settled(&self) -> bool {
        let mut written = self.writers.iter().filter(|(entity, _)| !entity.is_builtin());
        written.all(|(entity, writer)| {
            writer.state.is_settled() && !self.paths.values().any(|path| path.has_pending(*entity))
        })
    }

    /// Publishes changes that were made from outside.
    #[cfg(test)]
    pub fn flush_changes(&mut self) {
        self.publish_changes();
    }

    fn announcement_change(payload: Bytes) -> CacheChange {
        CacheChange { payload, related: None, written: WireTime::from(SystemTime::now()), status: 0, key: None }
    }

    fn builtin_qos() -> EndpointQos {
        EndpointQos {
            durability: DurabilityKind::TransientLocal,
            history: HistoryKind::KeepAll,
            ..EndpointQos::default()
        }
    }

    fn vendor_of(&self, prefix: GuidPrefix) -> VendorId {
        self.remotes.get(&prefix).map_or(VendorId::default(), |remote| remote.data.vendor)
    }
}
