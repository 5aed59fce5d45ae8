//! The participant without its sockets and its clock: datagrams and the time go in, datagrams and samples come out.
//!
//! ```text
//!   receive ─▶ discovering (who is there) ─▶ matching (what passes between which ends)
//!        │                                        │
//!        ├─▶ readers ─▶ deliveries                ▼
//!        └─▶ writers ─▶ Wanted ─▶ paths: one for each address ─▶ transmit
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
use self::paths::Path;
use self::predecessors::Predecessors;
use self::servers::Via;
use crate::discovery::ParticipantData;
use crate::locator::Ports;
use crate::network::Network;
use crate::participant::{Discovered, DiscoveryServer, Ends, Sample, Sink};
use crate::qos::{Durability, EndpointQos, History};
use crate::reader::{Bounds, ReaderState};
use crate::time::WireTime;
use crate::wire::DatagramWriter;
use crate::writer::{Change, Wanted, WriterState};
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
    fn whole(to: SocketAddr, writer: DatagramWriter) -> Self {
        Self {
            to,
            head: writer.finish(),
            body: Bytes::new(),
            tail: &[],
        }
    }

    /// What is sent, one part after the other.
    pub fn parts(&self) -> [IoSlice<'_>; 3] {
        [&self.head, &self.body[..], self.tail].map(IoSlice::new)
    }
}

/// Another participant.
#[derive(Debug)]
struct Remote {
    data: Arc<ParticipantData>,
    /// Where it hears of ends.
    discovery: SocketAddr,
    /// Where its ends receive.
    user: SocketAddr,
    /// By whom it is known.
    via: Via,
    heard: Instant,
    /// When it was asked first whether it is there, since it was heard last.
    asked: Option<Instant>,
}

/// A writer of ours.
struct LocalWriter {
    state: WriterState,
    ends: watch::Sender<Arc<Ends>>,
    /// It was taken back, and is kept until then for those who have not got all of it.
    leaves: Option<Instant>,
}

/// A reader of ours; those of the protocol have no sink.
struct LocalReader {
    state: ReaderState,
    ends: watch::Sender<Arc<Ends>>,
    sink: Option<Arc<dyn Sink>>,
}

/// How a participant is made.
pub(crate) struct Settings {
    pub own: ParticipantData,
    pub ports: Ports,
    pub bounds: Bounds,
    /// Where it announces itself to whoever does not know it yet.
    pub announce_to: Vec<SocketAddr>,
    /// Servers of discovery: where there are some, it announces itself to them alone.
    pub servers: Vec<DiscoveryServer>,
    pub network: Network,
    /// Whether it tells nobody of itself, and hears nobody.
    pub alone: bool,
    /// Who ended without a word, and had this participant's lease.
    pub predecessors: Vec<GuidPrefix>,
}

/// A participant.
pub(crate) struct Engine {
    own: ParticipantData,
    ports: Ports,
    bounds: Bounds,
    announce_to: Vec<SocketAddr>,
    servers: Vec<DiscoveryServer>,
    announcements: i64,
    announce_at: Instant,
    announce_pause: Duration,
    network: Network,
    alone: bool,
    predecessors: Predecessors,
    /// Which of the domain's ports of this machine were bound when they were looked at last.
    bound: BTreeSet<SocketAddrV4>,
    remotes: HashMap<GuidPrefix, Remote>,
    discovered: Discovered,
    discovered_changed: bool,
    told: watch::Sender<Arc<Discovered>>,
    writers: HashMap<EntityId, LocalWriter>,
    readers: HashMap<EntityId, LocalReader>,
    /// Which numbers announce our ends, and which take them back.
    announced: HashMap<EntityId, SequenceNumber>,
    withdrawn: VecDeque<(EntityId, SequenceNumber)>,
    next_entity: u32,
    /// Ends whose `Ends` have changed.
    changed_ends: BTreeSet<EntityId>,
    control: VecDeque<Datagram>,
    paths: BTreeMap<SocketAddr, Path>,
    next_path: Option<SocketAddr>,
    deliveries: Vec<(Arc<dyn Sink>, Sample)>,
    tick_at: Instant,
    closed: bool,
    /// It was said that there are more others than are heard.
    crowded: bool,
}

impl Engine {
    pub fn new(now: Instant, settings: Settings) -> Self {
        let Settings {
            own,
            ports,
            bounds,
            announce_to,
            servers,
            network,
            alone,
            predecessors,
        } = settings;
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
            discovered: Discovered::default(),
            discovered_changed: false,
            told: watch::Sender::new(Arc::default()),
            writers: HashMap::new(),
            readers: HashMap::new(),
            announced: HashMap::new(),
            withdrawn: VecDeque::new(),
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
        engine.add_builtin_ends();
        if engine.is_client() {
            engine.add_ends_for_servers(now);
        }
        engine
    }

    pub fn guid(&self) -> Guid {
        Guid::new(self.own.prefix, EntityId::PARTICIPANT)
    }

    pub fn discovered(&self) -> watch::Receiver<Arc<Discovered>> {
        self.told.subscribe()
    }

    /// When `tick` is to be called again.
    pub fn tick_at(&self) -> Instant {
        self.tick_at
    }

    fn wake(&mut self, at: Instant) {
        self.tick_at = self.tick_at.min(at);
    }

    /// Samples for sinks, since the last time. They are given on when nobody holds the engine.
    pub fn take_deliveries(&mut self) -> Vec<(Arc<dyn Sink>, Sample)> {
        std::mem::take(&mut self.deliveries)
    }

    /// Does what is due.
    pub fn tick(&mut self, now: Instant) {
        let mut again = self.tick_discovery(now);
        let mut answers = Vec::new();
        let mut announcements = Vec::new();
        for (entity, reader) in &mut self.readers {
            let mut out = Vec::new();
            again = again.min(
                reader
                    .state
                    .tick(now, &mut answers, &mut out)
                    .unwrap_or(again),
            );
            match &reader.sink {
                Some(sink) => self
                    .deliveries
                    .extend(out.into_iter().map(|sample| (Arc::clone(sink), sample))),
                None => announcements.extend(out.into_iter().map(|sample| (*entity, sample))),
            }
        }
        for (entity, sample) in announcements {
            self.announced(now, entity, &sample);
        }
        for answer in answers {
            self.answer(answer);
        }
        let mut all = Vec::new();
        for (entity, writer) in &mut self.writers {
            let mut wanted = Wanted::default();
            again = again.min(writer.state.tick(now, &mut wanted).unwrap_or(again));
            all.push((*entity, wanted));
        }
        for (entity, wanted) in all {
            self.enqueue(entity, wanted);
        }
        self.tick_at = again;
        self.let_go(now);
        self.tell();
    }

    /// Says good-bye; what is lined up then is the last.
    pub fn close(&mut self, now: Instant) {
        if !std::mem::replace(&mut self.closed, true) {
            self.say_goodbye(now);
        }
    }

    /// Whether readers have all that was written to them.
    pub fn is_settled(&self) -> bool {
        let mut written = self
            .writers
            .iter()
            .filter(|(entity, _)| !entity.is_builtin());
        written.all(|(entity, writer)| {
            writer.state.is_settled() && !self.paths.values().any(|path| path.holds(*entity))
        })
    }

    /// Tells whoever waits, after something was changed from outside.
    #[cfg(test)]
    pub fn settle(&mut self) {
        self.tell();
    }

    fn change_of_announcement(payload: Bytes) -> Change {
        Change {
            payload,
            related: None,
            written: WireTime::from(SystemTime::now()),
            status: 0,
            key: None,
        }
    }

    fn builtin_qos() -> EndpointQos {
        EndpointQos {
            durability: Durability::TransientLocal,
            history: History::KeepAll,
            ..EndpointQos::default()
        }
    }

    fn vendor_of(&self, prefix: GuidPrefix) -> VendorId {
        self.remotes
            .get(&prefix)
            .map_or(VendorId::default(), |remote| remote.data.vendor)
    }
}
