//! One reader of ours: what has come of each matched writer, and what is missing (8.4.10 to 8.4.12).
//!
//! ```text
//!   DATA, DATA_FRAG ─▶ WriterProxy: in order? ─▶ samples
//!                          │ no: kept until what is before it has come, or will never come (HEARTBEAT, GAP)
//!   HEARTBEAT ─────────────┴─▶ ACKNACK, NACK_FRAG
//! ```

#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use budget::Budget;

use crate::discovery::EndpointData;
use crate::fragments::{Assembly, Progress};
use crate::participant::Sample;
use crate::qos::{Durability, Reliability};
use crate::sequence::{FragmentNumber, SPAN, SequenceNumber, SequenceSet};
use crate::time::WireTime;
use crate::wire::{DataFrag, NackFrag};
use crate::writer::Counts;
use crate::{EntityId, Guid, GuidPrefix, VendorId, wire};

/// A writer that has not told yet what it has is asked so often; each time the pause doubles, up to two seconds.
const FIRST_ASK: Duration = Duration::from_millis(10);
const SELDOM_ASK: Duration = Duration::from_secs(2);
/// A volatile reader does not wait longer for a writer's first heartbeat: what has come is passed on then.
const NO_HEARTBEAT: Duration = Duration::from_millis(200);
/// What was asked for again is asked for once more after this time.
const ASK_AGAIN: Duration = Duration::from_millis(20);
/// Fragments of a sample that are on their way are not asked for.
const UNDER_WAY: Duration = Duration::from_millis(5);
/// What has come is acknowledged so much later.
const ACKNOWLEDGE: Duration = Duration::from_millis(5);
/// Samples of one writer that are put together at the same time. Best-effort writers may lose any of them.
const MOST_ASSEMBLIES: usize = 8;
/// Samples that wait for one before them.
const MOST_WAITING: usize = SPAN as usize;
/// What it takes to keep a sample, beside its bytes: many small ones count, too.
const KEEPING: usize = 256;

/// What holds for all readers of a participant.
#[derive(Debug, Clone)]
pub(crate) struct Bounds {
    pub max_sample: usize,
    pub budget: Budget,
    pub unfinished: Duration,
}

/// What a reader answers to a writer.
#[derive(Debug)]
pub(crate) struct Answer {
    pub to: SocketAddr,
    pub prefix: GuidPrefix,
    pub acknack: wire::AckNack,
    pub nack_frags: Vec<NackFrag>,
}

/// What came of one writer.
#[derive(Debug)]
struct WriterProxy {
    data: Arc<EndpointData>,
    address: SocketAddr,
    vendor: VendorId,
    /// Both sides are reliable: what is missing is asked for.
    reliable: bool,
    /// The number that is passed on next.
    next: SequenceNumber,
    /// Whether `next` is known: a reliable writer tells it by its first heartbeat.
    begun: bool,
    matched: Instant,
    /// Numbers after `next`: samples, or the word that there is none, which costs hardly anything.
    waiting: BTreeMap<SequenceNumber, Option<Box<Sample>>>,
    assemblies: BTreeMap<SequenceNumber, Assembly>,
    /// The last number that the writer has told of.
    last: SequenceNumber,
    heartbeats: Counts,
    acknacks: u32,
    nack_frags: u32,
    answer_at: Option<Instant>,
    pause: Duration,
    /// It has told something to this reader or to all: it knows this reader, as far as can be known.
    heard: bool,
}

/// The state of one reader.
#[derive(Debug)]
pub(crate) struct ReaderState {
    pub own: EndpointData,
    bounds: Bounds,
    proxies: Vec<WriterProxy>,
    /// The most that was said to a writer that has gone.
    counted: u32,
    /// Samples that were not taken: too long, or without room for them.
    pub refused: u64,
}

impl ReaderState {
    pub fn new(own: EndpointData, bounds: Bounds) -> Self {
        Self {
            own,
            bounds,
            proxies: Vec::new(),
            counted: 0,
            refused: 0,
        }
    }

    /// A writer matches. A reliable one is asked at once what it has.
    pub fn matched(
        &mut self,
        now: Instant,
        data: Arc<EndpointData>,
        address: SocketAddr,
        vendor: VendorId,
    ) {
        self.unmatched(data.guid);
        let both = |qos: Reliability| qos == Reliability::Reliable;
        let reliable = both(self.own.qos.reliability) && both(data.qos.reliability);
        self.proxies.push(WriterProxy {
            data,
            address,
            vendor,
            reliable,
            next: SequenceNumber(1),
            begun: !reliable,
            matched: now,
            waiting: BTreeMap::new(),
            assemblies: BTreeMap::new(),
            last: SequenceNumber(0),
            heartbeats: Counts::default(),
            // A writer that is met anew need not know that.
            acknacks: self.counted,
            nack_frags: self.counted,
            answer_at: reliable.then_some(now),
            pause: FIRST_ASK,
            heard: false,
        });
    }

    /// A writer has gone; whether it was matched.
    pub fn unmatched(&mut self, writer: Guid) -> bool {
        let before = self.proxies.len();
        let counted = &mut self.counted;
        self.proxies.retain(|proxy| {
            let stays = proxy.data.guid != writer;
            if !stays {
                *counted = (*counted).max(proxy.acknacks).max(proxy.nack_frags);
            }
            stays
        });
        before != self.proxies.len()
    }

    /// The writers that are matched, in the order in which they came, each with whether it has told anything.
    pub fn writers(&self) -> impl Iterator<Item = (&Arc<EndpointData>, bool)> {
        self.proxies
            .iter()
            .map(|proxy| (&proxy.data, proxy.heard || !proxy.reliable))
    }

    fn waits_for_past(&self) -> bool {
        self.own.qos.durability >= Durability::TransientLocal
    }

    /// A whole sample. True where this shows for the first time that the writer knows this reader.
    pub fn data(
        &mut self,
        now: Instant,
        writer: Guid,
        sample: Sample,
        out: &mut Vec<Sample>,
    ) -> bool {
        let Bounds {
            max_sample, budget, ..
        } = &self.bounds;
        let Some(proxy) = self
            .proxies
            .iter_mut()
            .find(|proxy| proxy.data.guid == writer)
        else {
            return false;
        };
        if sample.payload.len() > *max_sample {
            self.refused += 1;
            return false;
        }
        let number = sample.number;
        match proxy.counted(sample, budget) {
            Some(sample) => {
                proxy.assemblies.remove(&number);
                proxy.take(sample, out);
            }
            None => {
                self.refused += 1;
                proxy.ask_again(now, number);
            }
        }
        !std::mem::replace(&mut proxy.heard, true)
    }

    /// A number without a sample: what it withdraws is of no concern here.
    pub fn nothing(&mut self, writer: Guid, number: SequenceNumber, out: &mut Vec<Sample>) {
        if let Some(proxy) = self
            .proxies
            .iter_mut()
            .find(|proxy| proxy.data.guid == writer)
        {
            proxy.pass_over(number, out);
        }
    }

    /// Fragments of a sample.
    pub fn data_frag(
        &mut self,
        now: Instant,
        writer: Guid,
        frag: &DataFrag,
        written: Option<WireTime>,
        out: &mut Vec<Sample>,
    ) -> bool {
        let Some(proxy) = self
            .proxies
            .iter_mut()
            .find(|proxy| proxy.data.guid == writer)
        else {
            return false;
        };
        let heard = !std::mem::replace(&mut proxy.heard, true);
        let number = frag.number;
        if number < proxy.next || proxy.waiting.contains_key(&number) {
            return heard;
        }
        if proxy.reliable && number.0 - proxy.next.0 >= MOST_WAITING as i64 {
            return heard;
        }
        if !proxy.assemblies.contains_key(&number) {
            let permit = self.bounds.budget.permit();
            let made = Assembly::new(
                frag.sample_size,
                frag.fragment_size,
                self.bounds.max_sample,
                permit,
                now,
            );
            let Some(assembly) = made else {
                self.refused += 1;
                proxy.pass_over(number, out);
                return heard;
            };
            if proxy.assemblies.len() >= MOST_ASSEMBLIES {
                // Of a best-effort writer the oldest will not be completed; a reliable one sends the newest once more.
                let Some(victim) = (if proxy.reliable {
                    proxy.assemblies.keys().next_back()
                } else {
                    proxy.assemblies.keys().next()
                })
                .copied() else {
                    return heard;
                };
                if proxy.reliable && victim < number {
                    return heard;
                }
                proxy.assemblies.remove(&victim);
            }
            proxy.assemblies.insert(number, assembly);
        }
        let Some(assembly) = proxy.assemblies.get_mut(&number) else {
            return heard;
        };
        assembly.related = assembly.related.or(frag.inline.related);
        assembly.written = assembly.written.or(written);
        match assembly.take(frag.first, frag.count, &frag.payload, now) {
            Progress::Missing => {}
            Progress::Refused => {
                self.refused += 1;
                proxy.assemblies.remove(&number);
                if proxy.reliable {
                    // What waits for this one may take the room that it needs; the newest of them is sent once more.
                    if proxy.waiting.keys().next_back() > Some(&number) {
                        proxy.waiting.pop_last();
                    }
                    proxy.ask_again(now, number);
                }
            }
            Progress::Whole => {
                if let Some(assembly) = proxy.assemblies.remove(&number) {
                    let (related, written) = (assembly.related, assembly.written);
                    let payload = assembly.into_bytes();
                    proxy.take(
                        Sample {
                            payload,
                            writer,
                            number,
                            related,
                            written,
                            withdrawn: None,
                        },
                        out,
                    );
                }
            }
        }
        if proxy.reliable && !proxy.assemblies.is_empty() {
            // Should the rest not come, it is asked for.
            proxy.ask_again(now, number);
        }
        heard
    }

    /// A writer tells what it has. True where this shows for the first time that it knows this reader.
    pub fn heartbeat(
        &mut self,
        now: Instant,
        writer: Guid,
        beat: &wire::Heartbeat,
        out: &mut Vec<Sample>,
    ) -> bool {
        let Some(proxy) = self
            .proxies
            .iter_mut()
            .find(|proxy| proxy.data.guid == writer)
        else {
            return false;
        };
        // A first number of 0 or less, or one beyond the last by more than one, is none (8.3.8.6.3).
        if !proxy.reliable || beat.first.0 < 1 || beat.last.0 < beat.first.0 - 1 {
            return false;
        }
        if !proxy.heartbeats.takes(now, beat.count) {
            return false;
        }
        proxy.begin(beat.first, out);
        proxy.last = proxy.last.max(beat.last);
        proxy.skip_to(beat.first, out);
        proxy.pause = FIRST_ASK;
        let missing = proxy.last >= proxy.next;
        if missing {
            proxy.answer_at = Some(now);
        } else if !beat.is_final {
            // One answer for all heartbeats of this time.
            proxy.answer_at = Some(proxy.answer_at.unwrap_or(now + ACKNOWLEDGE));
        }
        !std::mem::replace(&mut proxy.heard, true)
    }

    /// A writer tells that a sample has so many fragments by now.
    pub fn heartbeat_frag(&mut self, now: Instant, writer: Guid, beat: &wire::HeartbeatFrag) {
        let Some(proxy) = self
            .proxies
            .iter_mut()
            .find(|proxy| proxy.data.guid == writer)
        else {
            return;
        };
        if proxy.reliable && proxy.assemblies.contains_key(&beat.number) {
            proxy.answer_at = Some(now + UNDER_WAY);
        }
    }

    /// Numbers that will never come.
    pub fn gap(&mut self, writer: Guid, gap: &wire::Gap, out: &mut Vec<Sample>) {
        let Some(proxy) = self
            .proxies
            .iter_mut()
            .find(|proxy| proxy.data.guid == writer)
        else {
            return;
        };
        if gap.start.0 < 1 || gap.set.base < gap.start {
            return;
        }
        if gap.start <= proxy.next {
            proxy.skip_to(gap.set.base, out);
        } else {
            let until = gap
                .set
                .base
                .0
                .min(proxy.next.0.saturating_add(MOST_WAITING as i64));
            for number in gap.start.0..until {
                proxy.none(SequenceNumber(number));
            }
        }
        for number in gap.set.iter() {
            proxy.none(number);
        }
        proxy.pass_on(out);
    }

    /// When this writer is to be answered.
    pub fn answer_at(&self, writer: Guid) -> Option<Instant> {
        self.proxies
            .iter()
            .find(|proxy| proxy.data.guid == writer)?
            .answer_at
    }

    /// What is due at `now`: answers, and samples that waited for a heartbeat that never came. The time when to call again.
    pub fn tick(
        &mut self,
        now: Instant,
        answers: &mut Vec<Answer>,
        out: &mut Vec<Sample>,
    ) -> Option<Instant> {
        let past = self.waits_for_past();
        let (own, unfinished) = (self.own.guid.entity, self.bounds.unfinished);
        let mut again: Option<Instant> = None;
        for proxy in &mut self.proxies {
            proxy
                .assemblies
                .retain(|_, assembly| now.saturating_duration_since(assembly.heard) < unfinished);
            if !proxy.begun && !past && now.saturating_duration_since(proxy.matched) >= NO_HEARTBEAT
            {
                if let Some(first) = proxy.waiting.keys().next().copied() {
                    proxy.begin(first, out);
                }
            }
            if proxy.answer_at.is_some_and(|at| at <= now) {
                answers.push(proxy.answer(now, own));
            }
            let wake = [
                proxy.answer_at,
                proxy
                    .assemblies
                    .values()
                    .map(|assembly| assembly.heard + unfinished)
                    .min(),
            ];
            again = wake.into_iter().flatten().chain(again).min();
        }
        again
    }
}

impl WriterProxy {
    /// The writer has told where it begins.
    fn begin(&mut self, first: SequenceNumber, out: &mut Vec<Sample>) {
        if !self.begun {
            self.begun = true;
            self.next = self.next.max(first);
            self.pass_on(out);
        }
    }

    /// This number is missing: it is asked for after a while, unless it comes.
    fn ask_again(&mut self, now: Instant, number: SequenceNumber) {
        self.last = self.last.max(number);
        self.answer_at = Some(self.answer_at.unwrap_or(now + ASK_AGAIN));
    }

    /// The same sample, counted in the budget if it has to wait for others; none if there is no room for it. A writer that
    /// never says where it begins, or leaves a hole, would have others kept for as long as it likes.
    fn counted(&self, sample: Sample, budget: &Budget) -> Option<Sample> {
        let passes = !self.reliable || self.begun && sample.number <= self.next;
        if passes || !self.has_place(sample.number) {
            return Some(sample);
        }
        let permit = budget.take(sample.payload.len() + KEEPING).ok()?;
        // A part of a datagram keeps all of it.
        let payload = permit.around(sample.payload.to_vec());
        Some(Sample { payload, ..sample })
    }

    /// Whether this number would be kept, if it has to wait.
    fn has_place(&self, number: SequenceNumber) -> bool {
        let far = self.begun && number.0 - self.next.0 >= MOST_WAITING as i64;
        let full = self.waiting.len() >= MOST_WAITING && number != self.next;
        number >= self.next && !far && !full && !self.waiting.contains_key(&number)
    }

    /// Takes a sample that counts in the budget already, or need not wait.
    fn take(&mut self, sample: Sample, out: &mut Vec<Sample>) {
        let number = sample.number;
        if number < self.next {
            return;
        }
        if !self.reliable {
            self.assemblies = self.assemblies.split_off(&number.next());
            self.next = number.next();
            out.push(sample);
            return;
        }
        self.last = self.last.max(number);
        if self.begun && number == self.next {
            self.next = number.next();
            out.push(sample);
            self.pass_on(out);
        } else if self.has_place(number) {
            self.waiting.insert(number, Some(Box::new(sample)));
        }
    }

    /// A sample that will not be taken, however often it is sent.
    fn pass_over(&mut self, number: SequenceNumber, out: &mut Vec<Sample>) {
        if self.reliable {
            self.none(number);
            self.pass_on(out);
        }
    }

    fn none(&mut self, number: SequenceNumber) {
        let near = number >= self.next && number.0 - self.next.0 < MOST_WAITING as i64;
        if near {
            self.assemblies.remove(&number);
            self.waiting.entry(number).or_insert(None);
        }
    }

    /// Nothing before this number will come.
    fn skip_to(&mut self, first: SequenceNumber, out: &mut Vec<Sample>) {
        if first <= self.next {
            return;
        }
        let later = self.waiting.split_off(&first);
        // What has come of the ones before is passed on, in order.
        out.extend(
            std::mem::replace(&mut self.waiting, later)
                .into_values()
                .flatten()
                .map(|sample| *sample),
        );
        self.assemblies = self.assemblies.split_off(&first);
        self.next = first;
        self.pass_on(out);
    }

    fn pass_on(&mut self, out: &mut Vec<Sample>) {
        if !self.begun {
            return;
        }
        while let Some(entry) = self
            .waiting
            .first_entry()
            .filter(|entry| *entry.key() <= self.next)
        {
            let (number, sample) = entry.remove_entry();
            self.next = self.next.max(number.next());
            out.extend(sample.map(|sample| *sample));
        }
    }

    /// What the writer is told: what has come and what is missing.
    fn answer(&mut self, now: Instant, reader: EntityId) -> Answer {
        let writer = self.data.guid.entity;
        self.answer_at = None;
        if !self.begun {
            // Nothing is acknowledged and nothing is asked for: the writer answers with a heartbeat (8.3.7.1.5). Fast DDS takes
            // a base of 0 for that, others one of 1.
            self.answer_at = Some(now + self.pause);
            self.pause = (self.pause * 2).min(SELDOM_ASK);
            let set =
                SequenceSet::empty(SequenceNumber(i64::from(self.vendor != VendorId::FAST_DDS)));
            return self.told(reader, set, false, Vec::new());
        }
        let mut set = SequenceSet::empty(self.next);
        let until = self
            .last
            .0
            .min(self.next.0.saturating_add(i64::from(SPAN) - 1));
        let mut nack_frags = Vec::new();
        for number in (self.next.0..=until).map(SequenceNumber) {
            if self.waiting.contains_key(&number) {
                continue;
            }
            let Some(assembly) = self.assemblies.get(&number) else {
                set.insert(number);
                continue;
            };
            if now.saturating_duration_since(assembly.heard) < UNDER_WAY {
                continue;
            }
            let missing = assembly.missing(FragmentNumber::MAX);
            self.nack_frags = self.nack_frags.wrapping_add(1);
            nack_frags.push(NackFrag {
                reader,
                writer,
                number,
                set: missing,
                count: self.nack_frags,
            });
        }
        if self.last >= self.next {
            self.answer_at = Some(now + ASK_AGAIN.max(self.pause));
            self.pause = (self.pause * 2).min(SELDOM_ASK);
        }
        let is_final = set.is_empty();
        self.told(reader, set, is_final, nack_frags)
    }

    fn told(
        &mut self,
        reader: EntityId,
        set: SequenceSet,
        is_final: bool,
        nack_frags: Vec<NackFrag>,
    ) -> Answer {
        self.acknacks = self.acknacks.wrapping_add(1);
        let Guid {
            prefix,
            entity: writer,
        } = self.data.guid;
        let acknack = wire::AckNack {
            reader,
            writer,
            set,
            count: self.acknacks,
            is_final,
        };
        Answer {
            to: self.address,
            prefix,
            acknack,
            nack_frags,
        }
    }
}
