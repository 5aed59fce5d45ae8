//! A local writer: its history, and the progress of each matched reader (8.4.7 to 8.4.9).
//!
//! ```text
//!   publish ─▶ history ─▶ one item per address ─▶ path ─▶ DATA, or DATA_FRAG one by one
//!   ACKNACK ─▶ acknowledged │ requested again ─▶ items for that reader only │ dropped ─▶ GAP
//! ```

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;

use crate::count_filter::CountFilter;
use crate::discovery::EndpointData;
use crate::fragments::{self, FRAGMENT};
use crate::qos::{DurabilityKind, HistoryKind, ReliabilityKind};
use crate::sequence::{FragmentNumber, FragmentSet, SequenceNumber, SequenceSet};
use crate::time::WireTime;
use crate::{EntityId, Guid, GuidPrefix, SampleIdentity};

/// Heartbeat interval while a reader has not acknowledged everything.
const HEARTBEAT: Duration = Duration::from_millis(100);
/// First heartbeat interval for a reader that has not shown that it knows this writer; the interval doubles each time.
const FIRST_HEARTBEAT: Duration = Duration::from_millis(10);
/// Maximum size of the history in bytes. Beyond it the oldest samples are dropped regardless of the depth, except the
/// newest one and those that were started.
const MOST_BYTES: usize = 64 << 20;

/// Size of the history in bytes up to which samples that new readers are not given stay: the number that they are given
/// may grow.
const LITTLE: usize = 1 << 20;

/// Unacknowledged bytes of fragmented samples beyond which no further one is started for a reader: it is repaired
/// first, and samples replaced meanwhile were never started.
const WINDOW: usize = 8 << 20;

/// A sample in the history.
#[derive(Debug, Clone)]
pub(crate) struct CacheChange {
    /// CDR with its header; only the key for a disposal.
    pub payload: Bytes,
    pub related: Option<SampleIdentity>,
    pub written: WireTime,
    /// Status: 0, or the bits of `PID_STATUS_INFO` for a disposal.
    pub status: u32,
    pub key: Option<[u8; 16]>,
}

/// A part of a sample to be sent to one address.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct SendItem {
    pub writer: EntityId,
    /// One reader, or `UNKNOWN` for all at the address.
    pub reader: EntityId,
    pub prefix: GuidPrefix,
    pub number: SequenceNumber,
    /// The next and the last fragment to send; both 0 for an unfragmented sample.
    pub next: FragmentNumber,
    pub last: FragmentNumber,
}

/// Send requests of a writer.
#[derive(Debug, Default)]
pub(crate) struct SendRequests {
    /// Samples in order, each with its address.
    pub items: Vec<(SocketAddr, SendItem)>,
    /// Heartbeats: reader, first number, and whether a response is required.
    pub heartbeats: Vec<(SocketAddr, Guid, SequenceNumber, bool)>,
    /// Numbers that will never be sent, for one reader: the first, and the one after the last. Each range is sent
    /// separately, without the set of a GAP: for a number in the set, Fast DDS 2.14.5 looks up the sample at the set's
    /// base, and if it has fragments of that, forgets it partially (`StatefulReader::processGapMsg`). Takes from that
    /// reader then never return.
    pub gaps: Vec<(SocketAddr, Guid, SequenceNumber, SequenceNumber)>,
}

/// Progress of one reader.
#[derive(Debug)]
struct ReaderProxy {
    data: Arc<EndpointData>,
    address: SocketAddr,
    reliable: bool,
    /// Numbers up to this one are not relevant to it.
    irrelevant: SequenceNumber,
    /// It has received all numbers up to this one.
    acknowledged: SequenceNumber,
    /// It has answered, so it knows this writer.
    heard: bool,
    /// Time of the next heartbeat, unless it answers or acknowledges before.
    ask_at: Option<Instant>,
    pause: Duration,
    acknacks: CountFilter,
    nack_frags: CountFilter,
}

impl ReaderProxy {
    /// Returns whether it still has to acknowledge a sample.
    fn is_missing(&self, number: SequenceNumber) -> bool {
        self.reliable && self.acknowledged < number && self.irrelevant < number
    }
}

/// State of one writer.
#[derive(Debug)]
pub(crate) struct WriterState {
    pub own: EndpointData,
    history: BTreeMap<SequenceNumber, CacheChange>,
    /// Samples of which fragments were sent to reliable readers.
    begun: BTreeSet<SequenceNumber>,
    bytes: usize,
    /// Number of samples that new readers are given, of those in the history; `None`: all.
    kept: Option<usize>,
    last: SequenceNumber,
    proxies: Vec<ReaderProxy>,
    heartbeats: u32,
    /// Number of samples dropped before every reliable reader had acknowledged them.
    pub dropped: u64,
}

impl WriterState {
    pub fn new(own: EndpointData) -> Self {
        Self {
            own,
            history: BTreeMap::new(),
            begun: BTreeSet::new(),
            bytes: 0,
            kept: None,
            last: SequenceNumber(0),
            proxies: Vec::new(),
            heartbeats: 0,
            dropped: 0,
        }
    }

    pub fn is_reliable(&self) -> bool {
        self.own.qos.reliability == ReliabilityKind::Reliable
    }

    fn keeps_history(&self) -> bool {
        self.own.qos.durability >= DurabilityKind::TransientLocal
    }

    fn depth(&self) -> usize {
        match self.own.qos.history {
            HistoryKind::KeepLast(depth) => depth.max(1) as usize,
            HistoryKind::KeepAll => usize::MAX,
        }
    }

    pub fn change(&self, number: SequenceNumber) -> Option<&CacheChange> {
        self.history.get(&number)
    }

    /// Returns the first number in the history, or the one after the last if it is empty.
    pub fn first(&self) -> SequenceNumber {
        self.history.keys().next().copied().unwrap_or(self.last.next())
    }

    pub fn last(&self) -> SequenceNumber {
        self.last
    }

    /// Returns the next heartbeat count.
    pub fn count_heartbeat(&mut self) -> u32 {
        self.heartbeats = self.heartbeats.wrapping_add(1);
        self.heartbeats
    }

    /// Adds a sample to the history and requests it to be sent to all readers.
    pub fn publish(&mut self, now: Instant, change: CacheChange, wanted: &mut SendRequests) -> SequenceNumber {
        self.last = self.last.next();
        let number = self.last;
        let needed = self.keeps_history() || !self.proxies.is_empty();
        if !needed {
            return number;
        }
        self.bytes += change.payload.len();
        let length = change.payload.len();
        self.history.insert(number, change);
        self.trim();
        let mut told = BTreeSet::new();
        for proxy in &mut self.proxies {
            if proxy.reliable && proxy.ask_at.is_none() {
                proxy.pause = HEARTBEAT;
                proxy.ask_at = Some(now + HEARTBEAT);
            }
            if told.insert(proxy.address) {
                let item = new_item(&self.own, EntityId::UNKNOWN, proxy.data.guid.prefix, number, length);
                wanted.items.push((proxy.address, item));
            }
        }
        number
    }

    /// Removes a sample that is of no use to new readers: an announcement that was replaced by a later one.
    pub fn forget(&mut self, number: SequenceNumber) {
        self.begun.remove(&number);
        if let Some(change) = self.history.remove(&number) {
            self.bytes -= change.payload.len();
        }
    }

    /// Notes that fragments of a sample are being sent to an address. The sample is kept beyond the depth until the
    /// reliable readers there have received it: fragments may be lost, and a reader that gets a GAP for a partial
    /// sample may stall (Fast DDS 2.14).
    pub fn mark_started(&mut self, number: SequenceNumber, address: SocketAddr) {
        if self.needs_ack(address) && self.history.contains_key(&number) {
            self.begun.insert(number);
        }
    }

    pub fn is_started(&self, number: SequenceNumber) -> bool {
        self.begun.contains(&number)
    }

    /// Returns whether the readers at an address have as many unacknowledged bytes as allowed.
    pub fn is_window_full(&self, address: SocketAddr) -> bool {
        let missed = |number: &SequenceNumber| {
            let mut there = self.proxies.iter().filter(|it| it.address == address);
            there.any(|proxy| proxy.is_missing(*number))
        };
        let missed = self.begun.iter().filter(|number| missed(number));
        let bytes = missed.filter_map(|number| self.history.get(number));
        bytes.map(|change| change.payload.len()).sum::<usize>() >= WINDOW
    }

    /// Sets how many samples a new reader is given, at most the depth. Earlier ones stay in the history until the
    /// readers that are matched have received them, or longer if they are small.
    pub fn set_kept(&mut self, samples: usize) {
        self.kept = Some(samples.max(1));
        self.trim();
    }

    /// Returns the number up to which samples are not given to new readers.
    fn last_not_given(&self) -> SequenceNumber {
        let last = self.kept.and_then(|kept| self.history.keys().rev().nth(kept));
        last.copied().unwrap_or(SequenceNumber(0))
    }

    /// Drops samples beyond the depth and the memory limit, and those that neither new readers are given nor others
    /// still have to receive. Best-effort readers do not say what they have received.
    fn trim(&mut self) {
        while self.history.len() > self.depth().max(1) || self.bytes > MOST_BYTES {
            let Some(number) = self.oldest_droppable() else {
                break;
            };
            self.drop_sample(number);
        }
        if self.proxies.iter().any(|proxy| !proxy.reliable) {
            return;
        }
        while self.bytes > LITTLE && self.kept.is_some_and(|kept| self.history.len() > kept) {
            let first = self.first();
            if self.proxies.iter().any(|proxy| proxy.is_missing(first)) {
                return;
            }
            self.forget(first);
        }
    }

    fn oldest_droppable(&self) -> Option<SequenceNumber> {
        let waits = |number: &SequenceNumber| {
            let misses = |proxy: &ReaderProxy| proxy.is_missing(*number);
            self.begun.contains(number) && self.proxies.iter().any(misses)
        };
        let mut given_up = self.history.keys().filter(|number| !waits(number));
        given_up.find(|number| **number != self.last).copied()
    }

    fn drop_sample(&mut self, number: SequenceNumber) {
        let missed = self.proxies.iter().any(|proxy| proxy.is_missing(number));
        self.dropped += u64::from(missed);
        self.forget(number);
    }

    /// Removes samples that every reader has received, unless new readers are to receive them.
    fn release_acknowledged(&mut self) {
        if self.keeps_history() {
            self.trim();
            return;
        }
        let Some(least) = self.proxies.iter().filter(|proxy| proxy.reliable).map(|proxy| proxy.acknowledged).min()
        else {
            return;
        };
        while let Some(first) = self.history.keys().next().copied().filter(|first| *first <= least) {
            self.forget(first);
        }
    }

    /// Matches a reader. A reliable one gets a heartbeat immediately; one that requests it gets the history.
    pub fn add_reader(
        &mut self,
        now: Instant,
        data: Arc<EndpointData>,
        address: SocketAddr,
        wanted: &mut SendRequests,
    ) {
        let guid = data.guid;
        self.remove_reader(guid);
        let reliable = self.is_reliable() && data.qos.reliability == ReliabilityKind::Reliable;
        let all = self.keeps_history() && data.qos.durability >= DurabilityKind::TransientLocal;
        let irrelevant = if all { self.last_not_given() } else { self.last };
        self.proxies.push(ReaderProxy {
            data,
            address,
            reliable,
            irrelevant,
            acknowledged: irrelevant,
            heard: false,
            ask_at: reliable.then_some(now + FIRST_HEARTBEAT),
            pause: FIRST_HEARTBEAT,
            acknacks: CountFilter::default(),
            nack_frags: CountFilter::default(),
        });
        if all {
            for (number, change) in self.history.range(irrelevant.next()..) {
                let item = new_item(&self.own, guid.entity, guid.prefix, *number, change.payload.len());
                wanted.items.push((address, item));
            }
        }
        if reliable {
            let from = self.first().max(irrelevant.next());
            wanted.heartbeats.push((address, guid, from, true));
        }
    }

    /// Removes a reader; returns whether it was matched.
    pub fn remove_reader(&mut self, reader: Guid) -> bool {
        let before = self.proxies.len();
        self.proxies.retain(|proxy| proxy.data.guid != reader);
        self.release_acknowledged();
        before != self.proxies.len()
    }

    /// Returns the matched readers in the order of discovery, each with whether it has confirmed the match.
    pub fn readers(&self) -> impl Iterator<Item = (&Arc<EndpointData>, bool)> {
        self.proxies.iter().map(|proxy| (&proxy.data, proxy.heard || !proxy.reliable))
    }

    /// Returns the number up to which a reader has received everything; `None` if it is not matched.
    pub fn last_acknowledged(&self, reader: Guid) -> Option<SequenceNumber> {
        let mut proxies = self.proxies.iter();
        let proxy = proxies.find(|proxy| proxy.data.guid == reader)?;
        Some(proxy.acknowledged)
    }

    /// Handles an acknowledgement. Returns whether it shows for the first time that the reader knows this writer.
    pub fn on_acknack(
        &mut self,
        now: Instant,
        reader: Guid,
        set: &SequenceSet,
        count: u32,
        is_final: bool,
        wanted: &mut SendRequests,
    ) -> bool {
        let (first, last) = (self.first(), self.last);
        let Some(proxy) = self.proxies.iter_mut().find(|proxy| proxy.data.guid == reader) else {
            return false;
        };
        if !proxy.reliable || !proxy.acknacks.accept(now, count) {
            return false;
        }
        let known = std::mem::replace(&mut proxy.heard, true);
        let acknowledged = SequenceNumber(set.base.0.saturating_sub(1)).min(last);
        proxy.acknowledged = proxy.acknowledged.max(acknowledged);
        let mut gaps: Vec<(SequenceNumber, SequenceNumber)> = Vec::new();
        for number in set.iter().take_while(|number| *number <= last) {
            match self.history.get(&number).filter(|_| number > proxy.irrelevant) {
                Some(change) => {
                    let item = new_item(&self.own, reader.entity, reader.prefix, number, change.payload.len());
                    wanted.items.push((proxy.address, item));
                }
                None => match gaps.last_mut() {
                    Some((_, end)) if *end == number => *end = number.next(),
                    _ => gaps.push((number, number.next())),
                },
            }
        }
        let told = gaps.into_iter().map(|(start, end)| (proxy.address, reader, start, end));
        wanted.gaps.extend(told);
        if !is_final && set.is_empty() {
            let from = first.max(proxy.irrelevant.next());
            wanted.heartbeats.push((proxy.address, reader, from, true));
        }
        proxy.pause = HEARTBEAT;
        proxy.ask_at = (proxy.acknowledged < last).then_some(now + HEARTBEAT);
        self.release_acknowledged();
        !known
    }

    /// Handles a request for fragments of a sample.
    pub fn on_nack_frag(
        &mut self,
        now: Instant,
        reader: Guid,
        number: SequenceNumber,
        set: &FragmentSet,
        count: u32,
        wanted: &mut SendRequests,
    ) {
        let Some(proxy) = self.proxies.iter_mut().find(|proxy| proxy.data.guid == reader) else {
            return;
        };
        if !proxy.reliable || !proxy.nack_frags.accept(now, count) {
            return;
        }
        let Some(change) = self.history.get(&number) else {
            wanted.gaps.push((proxy.address, reader, number, number.next()));
            return;
        };
        let total = fragments::fragment_count(change.payload.len());
        let mut runs: VecDeque<(FragmentNumber, FragmentNumber)> = VecDeque::new();
        for fragment in set.iter().filter(|fragment| (1..=total).contains(fragment)) {
            match runs.back_mut() {
                Some((_, last)) if *last + 1 == fragment => *last = fragment,
                _ => runs.push_back((fragment, fragment)),
            }
        }
        for (next, last) in runs {
            let item = SendItem {
                writer: self.own.guid.entity,
                reader: reader.entity,
                prefix: reader.prefix,
                number,
                next,
                last,
            };
            wanted.items.push((proxy.address, item));
        }
    }

    /// Requests heartbeats for readers that have not acknowledged everything; returns the time of the next call.
    pub fn tick(&mut self, now: Instant, wanted: &mut SendRequests) -> Option<Instant> {
        let (first, last) = (self.first(), self.last);
        for proxy in &mut self.proxies {
            let Some(at) = proxy.ask_at.filter(|at| *at <= now) else {
                continue;
            };
            if proxy.heard && proxy.acknowledged >= last {
                proxy.ask_at = None;
                continue;
            }
            let from = first.max(proxy.irrelevant.next());
            wanted.heartbeats.push((proxy.address, proxy.data.guid, from, true));
            proxy.pause = (proxy.pause * 2).min(if proxy.heard { HEARTBEAT } else { HEARTBEAT * 20 });
            proxy.ask_at = Some(at.max(now) + proxy.pause);
        }
        self.next_heartbeat_at()
    }

    /// Requests a heartbeat for a reader of this participant that has answered before; returns whether there is one.
    pub fn request_ack(&self, participant: GuidPrefix, wanted: &mut SendRequests) -> bool {
        let mut proxies = self.proxies.iter();
        let Some(proxy) = proxies.find(|proxy| proxy.data.guid.prefix == participant && proxy.reliable && proxy.heard)
        else {
            return false;
        };
        let from = self.first().max(proxy.irrelevant.next());
        wanted.heartbeats.push((proxy.address, proxy.data.guid, from, true));
        true
    }

    /// Returns the time at which `tick` is to be called.
    pub fn next_heartbeat_at(&self) -> Option<Instant> {
        self.proxies.iter().filter_map(|proxy| proxy.ask_at).min()
    }

    /// Returns whether all readers have received everything.
    pub fn is_settled(&self) -> bool {
        self.proxies.iter().all(|proxy| !proxy.reliable || proxy.acknowledged >= self.last)
    }

    /// Returns the first number of a heartbeat for all readers at an address.
    pub fn relevant_from(&self, address: SocketAddr) -> SequenceNumber {
        let there = self.proxies.iter().filter(|proxy| proxy.address == address);
        let least = there.map(|proxy| proxy.irrelevant.next()).min().unwrap_or(self.last.next());
        self.first().max(least)
    }

    /// Returns whether a reader at this address must acknowledge.
    pub fn needs_ack(&self, address: SocketAddr) -> bool {
        self.proxies.iter().any(|proxy| proxy.address == address && proxy.reliable)
    }
}

fn new_item(
    own: &EndpointData,
    reader: EntityId,
    prefix: GuidPrefix,
    number: SequenceNumber,
    length: usize,
) -> SendItem {
    let last = if length > FRAGMENT { fragments::fragment_count(length) } else { 0 };
    SendItem { writer: own.guid.entity, reader, prefix, number, next: last.min(1), last }
}
