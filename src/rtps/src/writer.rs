//! One writer of ours: what it keeps, and how far each matched reader is (8.4.7 to 8.4.9).
//!
//! ```text
//!   publish ─▶ history ─▶ one item for each address ─▶ path ─▶ DATA, or DATA_FRAG one by one
//!   ACKNACK ─▶ acknowledged │ asked for again ─▶ items for that reader alone │ gone ─▶ GAP
//! ```

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;

use crate::discovery::EndpointData;
use crate::fragments::{self, FRAGMENT};
use crate::qos::{Durability, History, Reliability};
use crate::sequence::{FragmentNumber, FragmentSet, SequenceNumber, SequenceSet};
use crate::time::WireTime;
use crate::{EntityId, Guid, GuidPrefix, SampleIdentity};

/// While a reader has not acknowledged everything it is asked so often whether it has.
const HEARTBEAT: Duration = Duration::from_millis(100);
/// A reader that has not shown yet that it knows this writer is asked so often; each time the pause doubles.
const FIRST_HEARTBEAT: Duration = Duration::from_millis(10);
/// Beyond this many bytes the oldest samples are given up, whatever the depth says, except the newest one and those that were begun.
const MOST_BYTES: usize = 64 << 20;

/// No further sample in fragments is begun to a reader that has so many bytes of them to acknowledge: it is repaired first, and what
/// is replaced meanwhile was never begun.
const WINDOW: usize = 8 << 20;

/// A sample that is kept.
#[derive(Debug, Clone)]
pub(crate) struct Change {
    /// CDR with its header; only its key where something is withdrawn.
    pub payload: Bytes,
    pub related: Option<SampleIdentity>,
    pub written: WireTime,
    /// What is withdrawn by this: 0, or the bits of `PID_STATUS_INFO`.
    pub status: u32,
    pub key: Option<[u8; 16]>,
}

/// What is to be sent of one sample, to one address.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Item {
    pub writer: EntityId,
    /// One reader, or `UNKNOWN` for all at the address.
    pub reader: EntityId,
    pub prefix: GuidPrefix,
    pub number: SequenceNumber,
    /// Of a sample in fragments, the next one to send and the last one; 0 and 0 where it is sent whole.
    pub next: FragmentNumber,
    pub last: FragmentNumber,
}

/// What a writer wants sent.
#[derive(Debug, Default)]
pub(crate) struct Wanted {
    /// Samples, in order, each to its address.
    pub items: Vec<(SocketAddr, Item)>,
    /// Heartbeats: to which reader, from which number on, whether an answer is wanted.
    pub heartbeats: Vec<(SocketAddr, Guid, SequenceNumber, bool)>,
    /// Numbers that will never come, for one reader: the first one, and the one after the last. Each run is told by itself, without the set that a
    /// GAP can have: Fast DDS 2.14.5 looks for what it has of those in the set at the set's base, and where that is a sample of which it has
    /// fragments, it forgets that by half (`StatefulReader::processGapMsg`). Whoever takes from that reader then tries for ever.
    pub gaps: Vec<(SocketAddr, Guid, SequenceNumber, SequenceNumber)>,
}

/// How far one reader is.
#[derive(Debug)]
struct ReaderProxy {
    data: Arc<EndpointData>,
    address: SocketAddr,
    reliable: bool,
    /// Numbers up to this one do not concern it.
    irrelevant: SequenceNumber,
    /// It has all up to this one.
    acknowledged: SequenceNumber,
    /// It has answered: it knows this writer.
    heard: bool,
    /// Asked when it has not answered or acknowledged until then.
    ask_at: Option<Instant>,
    pause: Duration,
    acknacks: Counts,
    nack_frags: Counts,
}

impl ReaderProxy {
    /// Whether it has not acknowledged a sample that it is to acknowledge.
    fn misses(&self, number: SequenceNumber) -> bool {
        self.reliable && self.acknowledged < number && self.irrelevant < number
    }
}

/// The state of one writer.
#[derive(Debug)]
pub(crate) struct WriterState {
    pub own: EndpointData,
    history: BTreeMap<SequenceNumber, Change>,
    /// Samples of which reliable readers have been sent fragments.
    begun: BTreeSet<SequenceNumber>,
    bytes: usize,
    last: SequenceNumber,
    proxies: Vec<ReaderProxy>,
    heartbeats: u32,
    /// Samples that were given up before every reliable reader had acknowledged them.
    pub dropped: u64,
}

impl WriterState {
    pub fn new(own: EndpointData) -> Self {
        Self {
            own,
            history: BTreeMap::new(),
            begun: BTreeSet::new(),
            bytes: 0,
            last: SequenceNumber(0),
            proxies: Vec::new(),
            heartbeats: 0,
            dropped: 0,
        }
    }

    pub fn is_reliable(&self) -> bool {
        self.own.qos.reliability == Reliability::Reliable
    }

    fn keeps_for_newcomers(&self) -> bool {
        self.own.qos.durability >= Durability::TransientLocal
    }

    fn depth(&self) -> usize {
        match self.own.qos.history {
            History::KeepLast(depth) => depth.max(1) as usize,
            History::KeepAll => usize::MAX,
        }
    }

    pub fn change(&self, number: SequenceNumber) -> Option<&Change> {
        self.history.get(&number)
    }

    /// The first number that is kept; the one after the last where none is.
    pub fn first(&self) -> SequenceNumber {
        self.history
            .keys()
            .next()
            .copied()
            .unwrap_or(self.last.next())
    }

    pub fn last(&self) -> SequenceNumber {
        self.last
    }

    /// Takes the next count for a heartbeat.
    pub fn count_heartbeat(&mut self) -> u32 {
        self.heartbeats = self.heartbeats.wrapping_add(1);
        self.heartbeats
    }

    /// Keeps a sample and wants it sent to everybody.
    pub fn publish(&mut self, now: Instant, change: Change, wanted: &mut Wanted) -> SequenceNumber {
        self.last = self.last.next();
        let number = self.last;
        let needed = self.keeps_for_newcomers() || !self.proxies.is_empty();
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
                let item = item(
                    &self.own,
                    EntityId::UNKNOWN,
                    proxy.data.guid.prefix,
                    number,
                    length,
                );
                wanted.items.push((proxy.address, item));
            }
        }
        number
    }

    /// Takes a sample back that is of no use to newcomers any more: an announcement that a later one replaces.
    pub fn forget(&mut self, number: SequenceNumber) {
        self.begun.remove(&number);
        if let Some(change) = self.history.remove(&number) {
            self.bytes -= change.payload.len();
        }
    }

    /// Fragments of a sample are sent to an address. It is kept beyond the depth until whoever is to acknowledge it there has: part
    /// of it may be lost on the way, and a reader that is told that there is no more of it can come to a standstill (Fast DDS 2.14).
    pub fn begun(&mut self, number: SequenceNumber, address: SocketAddr) {
        if self.asks(address) && self.history.contains_key(&number) {
            self.begun.insert(number);
        }
    }

    pub fn is_begun(&self, number: SequenceNumber) -> bool {
        self.begun.contains(&number)
    }

    /// Whether those at an address have as much to acknowledge as they may.
    pub fn is_window_full(&self, address: SocketAddr) -> bool {
        let missed = |number: &SequenceNumber| {
            let mut there = self.proxies.iter().filter(|it| it.address == address);
            there.any(|proxy| proxy.misses(*number))
        };
        let missed = self.begun.iter().filter(|number| missed(number));
        let bytes = missed.filter_map(|number| self.history.get(number));
        bytes.map(|change| change.payload.len()).sum::<usize>() >= WINDOW
    }

    /// Gives up what is beyond the depth, and beyond the memory.
    fn trim(&mut self) {
        while self.history.len() > self.depth().max(1) || self.bytes > MOST_BYTES {
            let Some(number) = self.oldest_to_give_up() else {
                break;
            };
            self.give_up(number);
        }
    }

    fn oldest_to_give_up(&self) -> Option<SequenceNumber> {
        let waits = |number: &SequenceNumber| {
            let misses = |proxy: &ReaderProxy| proxy.misses(*number);
            self.begun.contains(number) && self.proxies.iter().any(misses)
        };
        let mut given_up = self.history.keys().filter(|number| !waits(number));
        given_up.find(|number| **number != self.last).copied()
    }

    fn give_up(&mut self, number: SequenceNumber) {
        let missed = self.proxies.iter().any(|proxy| proxy.misses(number));
        self.dropped += u64::from(missed);
        self.forget(number);
    }

    /// Lets go of what every reader has, unless newcomers are to be given it.
    fn let_go(&mut self) {
        if self.keeps_for_newcomers() {
            self.trim();
            return;
        }
        let Some(least) = self
            .proxies
            .iter()
            .filter(|proxy| proxy.reliable)
            .map(|proxy| proxy.acknowledged)
            .min()
        else {
            return;
        };
        while let Some(first) = self
            .history
            .keys()
            .next()
            .copied()
            .filter(|first| *first <= least)
        {
            self.forget(first);
        }
    }

    /// A reader matches. A reliable one is asked at once; one that wants to is given what is kept.
    pub fn matched(
        &mut self,
        now: Instant,
        data: Arc<EndpointData>,
        address: SocketAddr,
        wanted: &mut Wanted,
    ) {
        let guid = data.guid;
        self.unmatched(guid);
        let reliable = self.is_reliable() && data.qos.reliability == Reliability::Reliable;
        let all = self.keeps_for_newcomers() && data.qos.durability >= Durability::TransientLocal;
        let irrelevant = if all { SequenceNumber(0) } else { self.last };
        self.proxies.push(ReaderProxy {
            data,
            address,
            reliable,
            irrelevant,
            acknowledged: irrelevant,
            heard: false,
            ask_at: reliable.then_some(now + FIRST_HEARTBEAT),
            pause: FIRST_HEARTBEAT,
            acknacks: Counts::default(),
            nack_frags: Counts::default(),
        });
        if all {
            for (number, change) in &self.history {
                let item = item(
                    &self.own,
                    guid.entity,
                    guid.prefix,
                    *number,
                    change.payload.len(),
                );
                wanted.items.push((address, item));
            }
        }
        if reliable {
            let from = self.first().max(irrelevant.next());
            wanted.heartbeats.push((address, guid, from, true));
        }
    }

    /// A reader has gone; whether it was matched.
    pub fn unmatched(&mut self, reader: Guid) -> bool {
        let before = self.proxies.len();
        self.proxies.retain(|proxy| proxy.data.guid != reader);
        self.let_go();
        before != self.proxies.len()
    }

    /// The readers that are matched, in the order in which they came, each with whether it has shown that it knows this writer.
    pub fn readers(&self) -> impl Iterator<Item = (&Arc<EndpointData>, bool)> {
        self.proxies
            .iter()
            .map(|proxy| (&proxy.data, proxy.heard || !proxy.reliable))
    }

    /// Up to which number a reader has all; none where it is not matched.
    pub fn acknowledged(&self, reader: Guid) -> Option<SequenceNumber> {
        let mut proxies = self.proxies.iter();
        let proxy = proxies.find(|proxy| proxy.data.guid == reader)?;
        Some(proxy.acknowledged)
    }

    /// A reader tells what it has and what it misses; true where that shows for the first time that it knows this writer.
    pub fn acknack(
        &mut self,
        now: Instant,
        reader: Guid,
        set: &SequenceSet,
        count: u32,
        is_final: bool,
        wanted: &mut Wanted,
    ) -> bool {
        let (first, last) = (self.first(), self.last);
        let Some(proxy) = self
            .proxies
            .iter_mut()
            .find(|proxy| proxy.data.guid == reader)
        else {
            return false;
        };
        if !proxy.reliable || !proxy.acknacks.takes(now, count) {
            return false;
        }
        let known = std::mem::replace(&mut proxy.heard, true);
        let acknowledged = SequenceNumber(set.base.0.saturating_sub(1)).min(last);
        proxy.acknowledged = proxy.acknowledged.max(acknowledged);
        let mut gaps: Vec<(SequenceNumber, SequenceNumber)> = Vec::new();
        for number in set.iter().take_while(|number| *number <= last) {
            match self
                .history
                .get(&number)
                .filter(|_| number > proxy.irrelevant)
            {
                Some(change) => {
                    let item = item(
                        &self.own,
                        reader.entity,
                        reader.prefix,
                        number,
                        change.payload.len(),
                    );
                    wanted.items.push((proxy.address, item));
                }
                None => match gaps.last_mut() {
                    Some((_, end)) if *end == number => *end = number.next(),
                    _ => gaps.push((number, number.next())),
                },
            }
        }
        let told = gaps
            .into_iter()
            .map(|(start, end)| (proxy.address, reader, start, end));
        wanted.gaps.extend(told);
        if !is_final && set.is_empty() {
            let from = first.max(proxy.irrelevant.next());
            wanted.heartbeats.push((proxy.address, reader, from, true));
        }
        proxy.pause = HEARTBEAT;
        proxy.ask_at = (proxy.acknowledged < last).then_some(now + HEARTBEAT);
        self.let_go();
        !known
    }

    /// A reader misses fragments of a sample.
    pub fn nack_frag(
        &mut self,
        now: Instant,
        reader: Guid,
        number: SequenceNumber,
        set: &FragmentSet,
        count: u32,
        wanted: &mut Wanted,
    ) {
        let Some(proxy) = self
            .proxies
            .iter_mut()
            .find(|proxy| proxy.data.guid == reader)
        else {
            return;
        };
        if !proxy.reliable || !proxy.nack_frags.takes(now, count) {
            return;
        }
        let Some(change) = self.history.get(&number) else {
            wanted
                .gaps
                .push((proxy.address, reader, number, number.next()));
            return;
        };
        let total = fragments::count(change.payload.len());
        let mut runs: VecDeque<(FragmentNumber, FragmentNumber)> = VecDeque::new();
        for fragment in set.iter().filter(|fragment| (1..=total).contains(fragment)) {
            match runs.back_mut() {
                Some((_, last)) if *last + 1 == fragment => *last = fragment,
                _ => runs.push_back((fragment, fragment)),
            }
        }
        for (next, last) in runs {
            let item = Item {
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

    /// Asks the readers that have not acknowledged everything; the time when this is to be called again.
    pub fn tick(&mut self, now: Instant, wanted: &mut Wanted) -> Option<Instant> {
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
            wanted
                .heartbeats
                .push((proxy.address, proxy.data.guid, from, true));
            proxy.pause = (proxy.pause * 2).min(if proxy.heard {
                HEARTBEAT
            } else {
                HEARTBEAT * 20
            });
            proxy.ask_at = Some(at.max(now) + proxy.pause);
        }
        self.ask_at()
    }

    /// Asks a reader of this participant that has answered before; whether there is one.
    pub fn ask(&self, participant: GuidPrefix, wanted: &mut Wanted) -> bool {
        let mut proxies = self.proxies.iter();
        let Some(proxy) = proxies
            .find(|proxy| proxy.data.guid.prefix == participant && proxy.reliable && proxy.heard)
        else {
            return false;
        };
        let from = self.first().max(proxy.irrelevant.next());
        wanted
            .heartbeats
            .push((proxy.address, proxy.data.guid, from, true));
        true
    }

    /// When `tick` is to be called.
    pub fn ask_at(&self) -> Option<Instant> {
        self.proxies.iter().filter_map(|proxy| proxy.ask_at).min()
    }

    /// Whether no reader waits for anything.
    pub fn is_settled(&self) -> bool {
        self.proxies
            .iter()
            .all(|proxy| !proxy.reliable || proxy.acknowledged >= self.last)
    }

    /// From which number on a heartbeat to everybody at an address counts.
    pub fn relevant_from(&self, address: SocketAddr) -> SequenceNumber {
        let there = self.proxies.iter().filter(|proxy| proxy.address == address);
        let least = there
            .map(|proxy| proxy.irrelevant.next())
            .min()
            .unwrap_or(self.last.next());
        self.first().max(least)
    }

    /// Whether somebody at this address is to acknowledge.
    pub fn asks(&self, address: SocketAddr) -> bool {
        self.proxies
            .iter()
            .any(|proxy| proxy.address == address && proxy.reliable)
    }
}

fn item(
    own: &EndpointData,
    reader: EntityId,
    prefix: GuidPrefix,
    number: SequenceNumber,
    length: usize,
) -> Item {
    let last = if length > FRAGMENT {
        fragments::count(length)
    } else {
        0
    };
    Item {
        writer: own.guid.entity,
        reader,
        prefix,
        number,
        next: last.min(1),
        last,
    }
}

/// The counts of what another end says again and again (8.3.8.1, 8.3.8.6): what comes twice, or late, is told by them.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Counts {
    last: Option<(u32, Instant)>,
}

/// Nothing is so late. Whoever has heard nothing of us for the time of its lease meets us anew, and counts anew.
const TOO_LATE: Duration = Duration::from_secs(3);

impl Counts {
    /// Whether what has this count is to be heeded.
    pub fn takes(&mut self, now: Instant, count: u32) -> bool {
        let heeded = self.last.is_none_or(|(before, at)| {
            newer(count, before) || now.saturating_duration_since(at) > TOO_LATE
        });
        if heeded {
            self.last = Some((count, now));
        }
        heeded
    }
}

/// Whether a count comes after another one, though counts begin anew.
fn newer(count: u32, before: u32) -> bool {
    count.wrapping_sub(before).wrapping_sub(1) < u32::MAX / 2
}
