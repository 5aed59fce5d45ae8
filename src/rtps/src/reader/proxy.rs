//! Samples received from one writer, and those that are missing.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use budget::Budget;

use super::{AckResponse, MOST_WAITING, UNDER_WAY};
use crate::count_filter::CountFilter;
use crate::discovery::EndpointData;
use crate::fragments::Assembly;
use crate::qos::DurabilityKind;
use crate::sequence::{FragmentNumber, SPAN, SequenceNumber, SequenceSet};
use crate::shared::ReceivedSample;
use crate::wire::NackFrag;
use crate::{EntityId, Guid, VendorId, wire};

/// Longest interval between requests to a writer that has not announced its samples.
const SELDOM_ASK: Duration = Duration::from_secs(2);
/// Interval between resend requests for the same sample.
pub(super) const ASK_AGAIN: Duration = Duration::from_millis(20);
/// Maximum number of samples that a writer is said to keep for late readers.
const MAX_HISTORY: i64 = 256;
/// Overhead of a kept sample in bytes, which matters for many small ones.
pub(super) const KEEPING: usize = 256;

/// Receive state for one writer.
#[derive(Debug)]
pub(super) struct WriterProxy {
    pub(super) data: Arc<EndpointData>,
    pub(super) address: SocketAddr,
    pub(super) vendor: VendorId,
    /// Both sides are reliable, so missing samples are requested.
    pub(super) reliable: bool,
    /// Number of the next sample to deliver.
    pub(super) next: SequenceNumber,
    /// `next` is known: a reliable writer announces it with its first heartbeat.
    pub(super) begun: bool,
    pub(super) matched: Instant,
    /// Entries after `next`: a sample, or `None` for a number that has none, which takes almost no memory.
    pub(super) waiting: BTreeMap<SequenceNumber, Option<Box<ReceivedSample>>>,
    pub(super) assemblies: BTreeMap<SequenceNumber, Assembly>,
    /// Highest number announced by the writer.
    pub(super) last: SequenceNumber,
    /// Number of samples that the writer keeps for late readers, by its last heartbeat.
    pub(super) kept: Option<usize>,
    pub(super) heartbeats: CountFilter,
    pub(super) acknacks: u32,
    pub(super) nack_frags: u32,
    pub(super) answer_at: Option<Instant>,
    pub(super) pause: Duration,
    /// The writer has sent something to this reader or to all, so it knows this reader as far as can be told.
    pub(super) heard: bool,
}

impl WriterProxy {
    /// Notes how many samples a transient-local writer has for late readers: from the first to the last number that it
    /// announces (8.3.8.6.4). Returns whether that is news.
    pub(super) fn note_kept(&mut self, beat: &wire::Heartbeat) -> bool {
        if self.data.qos.durability < DurabilityKind::TransientLocal {
            return false;
        }
        let kept = (beat.last.0 - beat.first.0 + 1).clamp(0, MAX_HISTORY);
        let kept = usize::try_from(kept).ok();
        std::mem::replace(&mut self.kept, kept) != kept
    }

    /// Sets the first number that the writer has.
    pub(super) fn start_at(&mut self, first: SequenceNumber, out: &mut Vec<ReceivedSample>) {
        if !self.begun {
            self.begun = true;
            self.next = self.next.max(first);
            self.deliver_ready(out);
        }
    }

    /// Schedules a request for a missing number, unless it arrives before.
    pub(super) fn schedule_request(&mut self, now: Instant, number: SequenceNumber) {
        self.last = self.last.max(number);
        self.answer_at = Some(self.answer_at.unwrap_or(now + ASK_AGAIN));
    }

    /// Charges a sample to the budget if it must wait for others; `None` if it does not fit. Otherwise a writer that
    /// never announces its first number, or leaves a gap, could make us keep any amount.
    pub(super) fn charge_sample(&self, sample: ReceivedSample, budget: &Budget) -> Option<ReceivedSample> {
        let passes = !self.reliable || self.begun && sample.number <= self.next;
        if passes || !self.can_queue(sample.number) {
            return Some(sample);
        }
        let permit = budget.take(sample.payload.len() + KEEPING).ok()?;
        // A slice of a datagram would keep all of it.
        let payload = permit.wrap_bytes(sample.payload.to_vec());
        Some(ReceivedSample { payload, ..sample })
    }

    /// Returns whether a sample with this number would be queued if it must wait.
    fn can_queue(&self, number: SequenceNumber) -> bool {
        let far = self.begun && number.0 - self.next.0 >= MOST_WAITING as i64;
        let full = self.waiting.len() >= MOST_WAITING && number != self.next;
        number >= self.next && !far && !full && !self.waiting.contains_key(&number)
    }

    /// Accepts a sample that is charged to the budget or need not wait.
    pub(super) fn accept(&mut self, sample: ReceivedSample, out: &mut Vec<ReceivedSample>) {
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
            self.deliver_ready(out);
        } else if self.can_queue(number) {
            self.waiting.insert(number, Some(Box::new(sample)));
        }
    }

    /// Skips a sample that is never accepted, however often it is sent.
    pub(super) fn skip(&mut self, number: SequenceNumber, out: &mut Vec<ReceivedSample>) {
        if self.reliable {
            self.mark_absent(number);
            self.deliver_ready(out);
        }
    }

    pub(super) fn mark_absent(&mut self, number: SequenceNumber) {
        let near = number >= self.next && number.0 - self.next.0 < MOST_WAITING as i64;
        if near {
            self.assemblies.remove(&number);
            self.waiting.entry(number).or_insert(None);
        }
    }

    /// Skips all numbers before this one, which will not arrive.
    pub(super) fn skip_to(&mut self, first: SequenceNumber, out: &mut Vec<ReceivedSample>) {
        if first <= self.next {
            return;
        }
        let later = self.waiting.split_off(&first);
        // Earlier samples that have arrived are delivered in order.
        out.extend(std::mem::replace(&mut self.waiting, later).into_values().flatten().map(|sample| *sample));
        self.assemblies = self.assemblies.split_off(&first);
        self.next = first;
        self.deliver_ready(out);
    }

    pub(super) fn deliver_ready(&mut self, out: &mut Vec<ReceivedSample>) {
        if !self.begun {
            return;
        }
        while let Some(entry) = self.waiting.first_entry().filter(|entry| *entry.key() <= self.next) {
            let (number, sample) = entry.remove_entry();
            self.next = self.next.max(number.next());
            out.extend(sample.map(|sample| *sample));
        }
    }

    /// Creates the response to the writer: what has arrived and what is missing.
    pub(super) fn build_response(&mut self, now: Instant, reader: EntityId) -> AckResponse {
        let writer = self.data.guid.entity;
        self.answer_at = None;
        if !self.begun {
            // Acknowledges and requests nothing: the writer answers with a heartbeat (8.3.7.1.5). Fast DDS expects a
            // base of 0 for that, others a base of 1.
            self.answer_at = Some(now + self.pause);
            self.pause = (self.pause * 2).min(SELDOM_ASK);
            let set = SequenceSet::empty(SequenceNumber(i64::from(self.vendor != VendorId::FAST_DDS)));
            return self.build_acknack(reader, set, false, Vec::new());
        }
        let mut set = SequenceSet::empty(self.next);
        let until = self.last.0.min(self.next.0.saturating_add(i64::from(SPAN) - 1));
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
            let missing = assembly.missing_fragments(FragmentNumber::MAX);
            self.nack_frags = self.nack_frags.wrapping_add(1);
            nack_frags.push(NackFrag { reader, writer, number, set: missing, count: self.nack_frags });
        }
        if self.last >= self.next {
            self.answer_at = Some(now + ASK_AGAIN.max(self.pause));
            self.pause = (self.pause * 2).min(SELDOM_ASK);
        }
        let is_final = set.is_empty();
        self.build_acknack(reader, set, is_final, nack_frags)
    }

    fn build_acknack(
        &mut self,
        reader: EntityId,
        set: SequenceSet,
        is_final: bool,
        nack_frags: Vec<NackFrag>,
    ) -> AckResponse {
        self.acknacks = self.acknacks.wrapping_add(1);
        let Guid { prefix, entity: writer } = self.data.guid;
        let acknack = wire::AckNack { reader, writer, set, count: self.acknacks, is_final };
        AckResponse { to: self.address, prefix, acknack, nack_frags }
    }
}
