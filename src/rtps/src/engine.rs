//! The participant without its sockets and its clock: datagrams and the time go in, datagrams and samples come out.
//!
//! ```text
//!   receive ─▶ discovering (who is there) ─▶ matching (what passes between which ends)
//!        │                                        │
//!        ├─▶ readers ─▶ deliveries                ▼
//!        └─▶ writers ─▶ Wanted ─▶ paths: one for each address ─▶ transmit
//! ```

mod discovering;
mod matching;
mod paths;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::io::IoSlice;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;
use tokio::sync::watch;

pub(crate) use self::discovering::BUILTIN;
use self::paths::Path;
use crate::discovery::{EndpointData, ParticipantData};
use crate::locator::Ports;
use crate::participant::{Discovered, Ends, Sample, Sink, Topic};
use crate::qos::{Durability, EndpointQos, History};
use crate::reader::{Answer, Bounds, ReaderState};
use crate::time::WireTime;
use crate::wire::{self, DatagramWriter, Received, Submessage};
use crate::writer::{Change, Wanted, WriterState};
use crate::{EntityId, Guid, GuidPrefix, SampleIdentity, SequenceNumber, VendorId};

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
    heard: Instant,
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

/// A writer that was dropped is kept so long at most, until its readers have all that it wrote.
const LINGER: Duration = Duration::from_secs(2);
/// How often it is looked whether they have.
const LINGER_LOOK: Duration = Duration::from_millis(10);

/// How a participant is made.
pub(crate) struct Settings {
    pub own: ParticipantData,
    pub ports: Ports,
    pub bounds: Bounds,
    /// Where it announces itself to whoever does not know it yet.
    pub announce_to: Vec<SocketAddr>,
}

/// A participant.
pub(crate) struct Engine {
    own: ParticipantData,
    ports: Ports,
    bounds: Bounds,
    announce_to: Vec<SocketAddr>,
    announcements: i64,
    announce_at: Instant,
    announce_pause: Duration,
    /// Which of the domain's ports were bound when they were looked at last.
    bound: BTreeSet<u16>,
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
}

impl Engine {
    pub fn new(now: Instant, settings: Settings) -> Self {
        let Settings {
            own,
            ports,
            bounds,
            announce_to,
        } = settings;
        let mut engine = Self {
            own,
            ports,
            bounds,
            announce_to,
            announcements: 0,
            announce_at: now,
            announce_pause: discovering::FIRST_PAUSE,
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
        };
        engine.add_builtin_ends();
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

    // ---- ends of ours

    pub fn add_writer(
        &mut self,
        now: Instant,
        topic: &Topic,
        qos: EndpointQos,
    ) -> (Guid, watch::Receiver<Arc<Ends>>) {
        let entity = EntityId::user_writer(self.take_entity());
        let own = self.endpoint(entity, topic, qos);
        let ends = watch::Sender::new(Arc::default());
        let receiver = ends.subscribe();
        let guid = own.guid;
        self.writers.insert(
            entity,
            LocalWriter {
                state: WriterState::new(own.clone()),
                ends,
                leaves: None,
            },
        );
        self.match_own_writer(now, entity);
        self.announce_end(now, &own);
        self.tell();
        (guid, receiver)
    }

    pub fn add_reader(
        &mut self,
        now: Instant,
        topic: &Topic,
        qos: EndpointQos,
        sink: Arc<dyn Sink>,
    ) -> (Guid, watch::Receiver<Arc<Ends>>) {
        let entity = EntityId::user_reader(self.take_entity());
        let own = self.endpoint(entity, topic, qos);
        let ends = watch::Sender::new(Arc::default());
        let receiver = ends.subscribe();
        let guid = own.guid;
        let state = ReaderState::new(own.clone(), self.bounds.clone());
        self.readers.insert(
            entity,
            LocalReader {
                state,
                ends,
                sink: Some(sink),
            },
        );
        self.match_own_reader(now, entity);
        self.announce_end(now, &own);
        self.tell();
        (guid, receiver)
    }

    /// Takes an end of ours back; others are told. What is returned is to be dropped when nobody holds the engine.
    #[must_use]
    pub fn remove_end(&mut self, now: Instant, entity: EntityId) -> impl Sized + use<> {
        if let Some(writer) = self.writers.get_mut(&entity) {
            writer.leaves = Some(now + LINGER);
            self.let_go(now);
        }
        let reader = self.readers.remove(&entity);
        if reader.is_some() {
            self.withdraw_end(now, entity);
        }
        reader.map(|reader| reader.sink)
    }

    /// Takes those writers back that were dropped and have nothing left to send, or have had their time.
    fn let_go(&mut self, now: Instant) {
        let Engine { writers, paths, .. } = self;
        let done = |(entity, writer): (&EntityId, &LocalWriter)| {
            let leaves = writer.leaves?;
            let sent = writer.state.is_settled() && !paths.values().any(|path| path.holds(*entity));
            (sent || leaves <= now).then_some(*entity)
        };
        let done: Vec<EntityId> = writers.iter().filter_map(done).collect();
        for entity in done {
            self.writers.remove(&entity);
            self.paths.values_mut().for_each(|path| path.forget(entity));
            self.withdraw_end(now, entity);
        }
        if self.writers.values().any(|writer| writer.leaves.is_some()) {
            self.wake(now + LINGER_LOOK);
        }
    }

    fn take_entity(&mut self) -> u32 {
        // Three bytes of key; nobody makes so many ends at the same time.
        let number = self.next_entity;
        self.next_entity = (number + 1) & 0xff_ffff;
        number
    }

    fn endpoint(&self, entity: EntityId, topic: &Topic, qos: EndpointQos) -> EndpointData {
        EndpointData {
            guid: Guid::new(self.own.prefix, entity),
            topic: topic.name.clone(),
            type_name: topic.type_name.clone(),
            qos,
            user_data: topic.user_data.clone(),
            unicast: self.own.user.clone(),
            expects_inline_qos: false,
        }
    }

    /// Writes a sample of one of our writers.
    pub fn write(
        &mut self,
        now: Instant,
        entity: EntityId,
        payload: Bytes,
        related: Option<SampleIdentity>,
    ) -> SequenceNumber {
        let change = Change {
            payload,
            related,
            written: SystemTime::now().into(),
            status: 0,
            key: None,
        };
        self.publish(now, entity, change)
    }

    fn publish(&mut self, now: Instant, entity: EntityId, change: Change) -> SequenceNumber {
        let mut wanted = Wanted::default();
        let Some(writer) = self.writers.get_mut(&entity) else {
            return SequenceNumber::UNKNOWN;
        };
        let number = writer.state.publish(now, change, &mut wanted);
        let ask_at = writer.state.ask_at();
        self.enqueue(entity, wanted);
        self.tick_at = self.tick_at.min(ask_at.unwrap_or(self.tick_at));
        number
    }

    /// Samples of this writer that were given up before all reliable readers had acknowledged them.
    pub fn dropped(&self, entity: EntityId) -> u64 {
        self.writers
            .get(&entity)
            .map_or(0, |writer| writer.state.dropped)
    }

    // ---- what comes in

    /// Takes a datagram.
    pub fn receive(&mut self, now: Instant, datagram: &Bytes) {
        let parsed = wire::parse(datagram);
        if let Some(fault) = parsed.fault {
            tracing::trace!(%fault, "a datagram of RTPS was not read to its end");
        }
        for received in parsed.received {
            let other = received
                .to
                .is_some_and(|to| to != self.own.prefix && to != GuidPrefix::UNKNOWN);
            if !other && received.from != self.own.prefix {
                self.receive_submessage(now, received);
            }
        }
        self.tell();
    }

    fn receive_submessage(&mut self, now: Instant, received: Received) {
        let Received {
            from,
            vendor: _,
            written,
            submessage,
            ..
        } = received;
        match submessage {
            Submessage::Data(data) if data.writer == EntityId::SPDP_WRITER => {
                self.participant_heard(now, from, &data)
            }
            Submessage::Data(data) => {
                let writer = Guid::new(from, data.writer);
                let withdrawn = (data.inline.status != 0)
                    .then(|| crate::discovery::guid_of_key(&data))
                    .flatten();
                let is_sample = data.payload.is_some() && !data.key_only && data.inline.status == 0;
                self.for_readers(data.reader, writer, |reader, out| {
                    if is_sample || (reader.sink.is_none() && withdrawn.is_some()) {
                        let sample = Sample {
                            payload: data.payload.clone().unwrap_or_default(),
                            writer,
                            number: data.number,
                            related: data.inline.related,
                            written,
                            withdrawn,
                        };
                        reader.state.data(writer, sample, out)
                    } else {
                        reader.state.nothing(writer, data.number, out);
                        false
                    }
                });
            }
            Submessage::DataFrag(frag) => {
                let writer = Guid::new(from, frag.writer);
                if !frag.key_only {
                    self.for_readers(frag.reader, writer, |reader, out| {
                        reader.state.data_frag(now, writer, &frag, written, out)
                    });
                }
            }
            Submessage::Heartbeat(beat) => {
                let writer = Guid::new(from, beat.writer);
                self.for_readers(beat.reader, writer, |reader, out| {
                    reader.state.heartbeat(now, writer, &beat, out)
                });
            }
            Submessage::HeartbeatFrag(beat) => {
                let writer = Guid::new(from, beat.writer);
                self.for_readers(beat.reader, writer, |reader, _| {
                    reader.state.heartbeat_frag(now, writer, &beat);
                    false
                });
            }
            Submessage::Gap(gap) => {
                let writer = Guid::new(from, gap.writer);
                self.for_readers(gap.reader, writer, |reader, out| {
                    reader.state.gap(writer, &gap, out);
                    false
                });
            }
            Submessage::AckNack(ack) => {
                let mut wanted = Wanted::default();
                let reader = Guid::new(from, ack.reader);
                if let Some(writer) = self.writers.get_mut(&ack.writer) {
                    if writer.state.acknack(
                        now,
                        reader,
                        &ack.set,
                        ack.count,
                        ack.is_final,
                        &mut wanted,
                    ) {
                        self.changed_ends.insert(ack.writer);
                    }
                    let ask_at = writer.state.ask_at();
                    self.enqueue(ack.writer, wanted);
                    self.tick_at = self.tick_at.min(ask_at.unwrap_or(self.tick_at));
                }
            }
            Submessage::NackFrag(nack) => {
                let mut wanted = Wanted::default();
                let reader = Guid::new(from, nack.reader);
                if let Some(writer) = self.writers.get_mut(&nack.writer) {
                    writer
                        .state
                        .nack_frag(reader, nack.number, &nack.set, nack.count, &mut wanted);
                    self.enqueue(nack.writer, wanted);
                }
            }
        }
    }

    /// Has one reader, or all for `UNKNOWN`, take something of a writer. What `take` says is whether that shows for the first
    /// time that the writer knows the reader.
    fn for_readers(
        &mut self,
        entity: EntityId,
        writer: Guid,
        mut take: impl FnMut(&mut LocalReader, &mut Vec<Sample>) -> bool,
    ) {
        let mut announcements = Vec::new();
        let mut due = self.tick_at;
        let mut serve = |entity: EntityId, reader: &mut LocalReader| {
            let mut out = Vec::new();
            if take(reader, &mut out) {
                self.changed_ends.insert(entity);
            }
            due = due.min(reader.state.answer_at(writer).unwrap_or(due));
            match &reader.sink {
                Some(sink) => self
                    .deliveries
                    .extend(out.into_iter().map(|sample| (Arc::clone(sink), sample))),
                None => announcements.extend(out.into_iter().map(|sample| (entity, sample))),
            }
        };
        if entity == EntityId::UNKNOWN {
            for (entity, reader) in &mut self.readers {
                serve(*entity, reader);
            }
        } else if let Some(reader) = self.readers.get_mut(&entity) {
            serve(entity, reader);
        }
        self.tick_at = due;
        for (entity, sample) in announcements {
            self.end_heard(entity, &sample);
        }
    }

    // ---- time

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
            self.end_heard(entity, &sample);
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

    fn answer(&mut self, answer: Answer) {
        let mut writer = self.datagram(answer.prefix);
        writer.acknack(&answer.acknack);
        for nack in &answer.nack_frags {
            writer.nack_frag(nack);
        }
        self.control.push_back(Datagram::whole(answer.to, writer));
    }

    fn datagram(&self, to: GuidPrefix) -> DatagramWriter {
        let mut writer = DatagramWriter::new(self.own.prefix);
        writer.destination(to);
        writer
    }

    // ---- what goes out

    /// Lines up what a writer wants sent.
    fn enqueue(&mut self, entity: EntityId, wanted: Wanted) {
        for (to, item) in wanted.items {
            self.paths.entry(to).or_default().push(item);
        }
        let Some(writer) = self.writers.get_mut(&entity) else {
            return;
        };
        let last = writer.state.last();
        let mut out = Vec::new();
        for (to, reader, first, asks) in wanted.heartbeats {
            let beat = wire::Heartbeat {
                reader: reader.entity,
                writer: entity,
                first,
                last,
                count: writer.state.count_heartbeat(),
                is_final: !asks,
                liveliness: false,
            };
            out.push((to, reader.prefix, Submessage::Heartbeat(beat)));
        }
        for (to, reader, start, set) in wanted.gaps {
            let gap = wire::Gap {
                reader: reader.entity,
                writer: entity,
                start,
                set,
            };
            out.push((to, reader.prefix, Submessage::Gap(gap)));
        }
        for (to, prefix, submessage) in out {
            let mut writer = self.datagram(prefix);
            match &submessage {
                Submessage::Heartbeat(beat) => writer.heartbeat(beat),
                Submessage::Gap(gap) => writer.gap(gap),
                _ => continue,
            };
            self.control.push_back(Datagram::whole(to, writer));
        }
    }

    /// The next datagram to send; none where there is none, or where all that there are have to wait until their receivers
    /// have room (then [`Self::is_waiting`]). `room` tells whether there is some for a datagram of so many bytes.
    pub fn transmit(
        &mut self,
        room: &mut dyn FnMut(SocketAddr, usize) -> bool,
    ) -> Option<Datagram> {
        if let Some(datagram) = self.control.pop_front() {
            return Some(datagram);
        }
        // One address after the other.
        let after = self.next_path;
        let order: Vec<SocketAddr> = match after {
            Some(after) => {
                let later = self
                    .paths
                    .range(after..)
                    .map(|(to, _)| *to)
                    .filter(|to| *to != after);
                let earlier = self.paths.range(..=after).map(|(to, _)| *to);
                later.chain(earlier).collect()
            }
            None => self.paths.keys().copied().collect(),
        };
        for to in order {
            let Some(path) = self.paths.get_mut(&to) else {
                continue;
            };
            let Some(length) = path.prepare(&self.writers) else {
                self.paths.remove(&to);
                continue;
            };
            if !room(to, length) {
                continue;
            }
            self.next_path = Some(to);
            if let Some(datagram) =
                path.next(to, self.own.prefix, &mut self.writers, &mut self.control)
            {
                return Some(datagram);
            }
        }
        None
    }

    /// Whether something waits until its receiver has room.
    pub fn is_waiting(&self) -> bool {
        !self.paths.is_empty()
    }

    /// Says good-bye; what is lined up then is the last.
    pub fn close(&mut self) {
        if !std::mem::replace(&mut self.closed, true) {
            self.say_goodbye();
        }
    }

    /// Tells whoever waits, after something was changed from outside.
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
