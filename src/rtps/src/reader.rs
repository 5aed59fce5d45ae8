//! A local reader: what was received from each matched writer, and what is missing (8.4.10 to 8.4.12).
//!
//! ```text
//!   DATA, DATA_FRAG ─▶ WriterProxy: in order? ─▶ samples
//!                          │ no: kept until the earlier ones have arrived or will never arrive (HEARTBEAT, GAP)
//!   HEARTBEAT ─────────────┴─▶ ACKNACK, NACK_FRAG
//! ```

mod proxy;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use budget::Budget;

use crate::count_filter::CountFilter;
use crate::discovery::EndpointData;
use crate::fragments::{Assembly, Progress};
use crate::qos::{DurabilityKind, ReliabilityKind};
use crate::sequence::{SPAN, SequenceNumber};
use crate::shared::ReceivedSample;
use crate::time::WireTime;
use crate::wire::{DataFrag, NackFrag};
use crate::{Guid, GuidPrefix, VendorId, wire};
use proxy::WriterProxy;

/// First interval between requests to a writer that has not announced its samples; each one is twice as long as the one
/// before.
const FIRST_ASK: Duration = Duration::from_millis(10);
/// Time a volatile reader waits for a writer's first heartbeat before it delivers what has arrived.
const NO_HEARTBEAT: Duration = Duration::from_millis(200);
/// Time after a fragment during which missing fragments are not requested, because they are probably in flight.
const UNDER_WAY: Duration = Duration::from_millis(5);
/// Delay of an acknowledgement.
const ACKNOWLEDGE: Duration = Duration::from_millis(5);
/// Maximum number of samples of one writer reassembled at the same time. Those of best-effort writers may be lost.
const MOST_ASSEMBLIES: usize = 8;
/// Maximum number of samples waiting for an earlier one.
const MOST_WAITING: usize = SPAN as usize;

/// Limits of all readers of a participant.
#[derive(Debug, Clone)]
pub(crate) struct ReaderLimits {
    pub max_sample: usize,
    pub budget: Budget,
    pub unfinished: Duration,
}

/// The response of a reader to a writer.
#[derive(Debug)]
pub(crate) struct AckResponse {
    pub to: SocketAddr,
    pub prefix: GuidPrefix,
    pub acknack: wire::AckNack,
    pub nack_frags: Vec<NackFrag>,
}

/// State of one reader.
#[derive(Debug)]
pub(crate) struct ReaderState {
    pub own: EndpointData,
    bounds: ReaderLimits,
    proxies: Vec<WriterProxy>,
    /// Highest count sent to a writer that is gone.
    counted: u32,
    /// Number of samples dropped because they were too long or exceeded the budget.
    pub refused: u64,
}

impl ReaderState {
    pub fn new(own: EndpointData, bounds: ReaderLimits) -> Self {
        Self { own, bounds, proxies: Vec::new(), counted: 0, refused: 0 }
    }

    /// Matches a writer. A reliable one is asked immediately what it has.
    pub fn add_writer(&mut self, now: Instant, data: Arc<EndpointData>, address: SocketAddr, vendor: VendorId) {
        self.remove_writer(data.guid);
        let both = |qos: ReliabilityKind| qos == ReliabilityKind::Reliable;
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
            kept: None,
            heartbeats: CountFilter::default(),
            // A rediscovered writer may not know that it was gone, so counts continue.
            acknacks: self.counted,
            nack_frags: self.counted,
            answer_at: reliable.then_some(now),
            pause: FIRST_ASK,
            heard: false,
        });
    }

    /// Removes a writer; returns whether it was matched.
    pub fn remove_writer(&mut self, writer: Guid) -> bool {
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

    /// Returns the matched writers in the order of discovery, each with whether it has confirmed the match.
    pub fn writers(&self) -> impl Iterator<Item = (&Arc<EndpointData>, bool)> {
        self.proxies.iter().map(|proxy| (&proxy.data, proxy.heard || !proxy.reliable))
    }

    /// Returns the number of samples that each transient-local writer keeps for late readers, where it is known.
    pub fn kept_samples(&self) -> impl Iterator<Item = (Guid, usize)> {
        self.proxies.iter().filter_map(|proxy| Some((proxy.data.guid, proxy.kept?)))
    }

    fn wants_history(&self) -> bool {
        self.own.qos.durability >= DurabilityKind::TransientLocal
    }

    /// Handles a complete sample. Returns whether it shows for the first time that the writer knows this reader.
    pub fn on_data(
        &mut self,
        now: Instant,
        writer: Guid,
        sample: ReceivedSample,
        out: &mut Vec<ReceivedSample>,
    ) -> bool {
        let ReaderLimits { max_sample, budget, .. } = &self.bounds;
        let Some(proxy) = self.proxies.iter_mut().find(|proxy| proxy.data.guid == writer) else {
            return false;
        };
        if sample.payload.len() > *max_sample {
            self.refused += 1;
            return false;
        }
        let number = sample.number;
        match proxy.charge_sample(sample, budget) {
            Some(sample) => {
                proxy.assemblies.remove(&number);
                proxy.accept(sample, out);
            }
            None => {
                self.refused += 1;
                proxy.schedule_request(now, number);
            }
        }
        !std::mem::replace(&mut proxy.heard, true)
    }

    /// Handles a number without a sample; what it disposes of does not matter here.
    pub fn skip_sample(&mut self, writer: Guid, number: SequenceNumber, out: &mut Vec<ReceivedSample>) {
        if let Some(proxy) = self.proxies.iter_mut().find(|proxy| proxy.data.guid == writer) {
            proxy.skip(number, out);
        }
    }

    /// Handles fragments of a sample.
    pub fn on_data_frag(
        &mut self,
        now: Instant,
        writer: Guid,
        frag: &DataFrag,
        written: Option<WireTime>,
        out: &mut Vec<ReceivedSample>,
    ) -> bool {
        let Some(proxy) = self.proxies.iter_mut().find(|proxy| proxy.data.guid == writer) else {
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
            let made = Assembly::new(frag.sample_size, frag.fragment_size, self.bounds.max_sample, permit, now);
            let Some(assembly) = made else {
                self.refused += 1;
                proxy.skip(number, out);
                return heard;
            };
            if proxy.assemblies.len() >= MOST_ASSEMBLIES {
                // The oldest sample of a best-effort writer will not be completed; a reliable writer sends the newest
                // again.
                let Some(victim) =
                    (if proxy.reliable { proxy.assemblies.keys().next_back() } else { proxy.assemblies.keys().next() })
                        .copied()
                else {
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
        match assembly.add_fragments(frag.first, frag.count, &frag.payload, now) {
            Progress::Missing => {}
            Progress::Refused => {
                self.refused += 1;
                proxy.assemblies.remove(&number);
                if proxy.reliable {
                    // Queued samples may take the memory that this one needs; the newest of them will be sent again.
                    if proxy.waiting.keys().next_back() > Some(&number) {
                        proxy.waiting.pop_last();
                    }
                    proxy.schedule_request(now, number);
                }
            }
            Progress::Whole => {
                if let Some(assembly) = proxy.assemblies.remove(&number) {
                    let (related, written) = (assembly.related, assembly.written);
                    let payload = assembly.into_bytes();
                    proxy.accept(ReceivedSample { payload, writer, number, related, written, withdrawn: None }, out);
                }
            }
        }
        if proxy.reliable && !proxy.assemblies.is_empty() {
            // Requests the rest in case it does not arrive.
            proxy.schedule_request(now, number);
        }
        heard
    }

    /// Handles a heartbeat. Returns whether it shows for the first time that the writer knows this reader, or that it
    /// keeps another number of samples.
    pub fn on_heartbeat(
        &mut self,
        now: Instant,
        writer: Guid,
        beat: &wire::Heartbeat,
        out: &mut Vec<ReceivedSample>,
    ) -> bool {
        let wants_history = self.wants_history();
        let Some(proxy) = self.proxies.iter_mut().find(|proxy| proxy.data.guid == writer) else {
            return false;
        };
        // A first number below 1, or one beyond the last by more than one, is invalid (8.3.8.6.3).
        if !proxy.reliable || beat.first.0 < 1 || beat.last.0 < beat.first.0 - 1 {
            return false;
        }
        if !proxy.heartbeats.accept(now, beat.count) {
            return false;
        }
        proxy.start_at(beat.first, out);
        proxy.last = proxy.last.max(beat.last);
        proxy.skip_to(beat.first, out);
        proxy.pause = FIRST_ASK;
        let missing = proxy.last >= proxy.next;
        if missing {
            proxy.answer_at = Some(now);
        } else if !beat.is_final {
            // One response for all heartbeats of this interval.
            proxy.answer_at = Some(proxy.answer_at.unwrap_or(now + ACKNOWLEDGE));
        }
        let keeps_other = wants_history && proxy.note_kept(beat);
        !std::mem::replace(&mut proxy.heard, true) || keeps_other
    }

    /// Handles the announcement of the fragments available of a sample.
    pub fn on_heartbeat_frag(&mut self, now: Instant, writer: Guid, beat: &wire::HeartbeatFrag) {
        let Some(proxy) = self.proxies.iter_mut().find(|proxy| proxy.data.guid == writer) else {
            return;
        };
        if proxy.reliable && proxy.assemblies.contains_key(&beat.number) {
            proxy.answer_at = Some(now + UNDER_WAY);
        }
    }

    /// Handles numbers that will never be sent.
    pub fn on_gap(&mut self, writer: Guid, gap: &wire::Gap, out: &mut Vec<ReceivedSample>) {
        let Some(proxy) = self.proxies.iter_mut().find(|proxy| proxy.data.guid == writer) else {
            return;
        };
        if gap.start.0 < 1 || gap.set.base < gap.start {
            return;
        }
        if gap.start <= proxy.next {
            proxy.skip_to(gap.set.base, out);
        } else {
            let until = gap.set.base.0.min(proxy.next.0.saturating_add(MOST_WAITING as i64));
            for number in gap.start.0..until {
                proxy.mark_absent(SequenceNumber(number));
            }
        }
        for number in gap.set.iter() {
            proxy.mark_absent(number);
        }
        proxy.deliver_ready(out);
    }

    /// Returns the time at which a response to this writer is due.
    pub fn answer_at(&self, writer: Guid) -> Option<Instant> {
        self.proxies.iter().find(|proxy| proxy.data.guid == writer)?.answer_at
    }

    /// Collects responses that are due, and samples that waited for a heartbeat in vain. Returns the time of the next
    /// call.
    pub fn tick(
        &mut self,
        now: Instant,
        answers: &mut Vec<AckResponse>,
        out: &mut Vec<ReceivedSample>,
    ) -> Option<Instant> {
        let past = self.wants_history();
        let (own, unfinished) = (self.own.guid.entity, self.bounds.unfinished);
        let mut again: Option<Instant> = None;
        for proxy in &mut self.proxies {
            proxy.assemblies.retain(|_, assembly| now.saturating_duration_since(assembly.heard) < unfinished);
            if !proxy.begun && !past && now.saturating_duration_since(proxy.matched) >= NO_HEARTBEAT {
                if let Some(first) = proxy.waiting.keys().next().copied() {
                    proxy.start_at(first, out);
                }
            }
            if proxy.answer_at.is_some_and(|at| at <= now) {
                answers.push(proxy.build_response(now, own));
            }
            let wake = [proxy.answer_at, proxy.assemblies.values().map(|assembly| assembly.heard + unfinished).min()];
            again = wake.into_iter().flatten().chain(again).min();
        }
        again
    }
}
