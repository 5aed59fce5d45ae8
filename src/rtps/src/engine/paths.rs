//! Send queues per address: one queue for each writer, served round-robin, so that a large sample of one writer does
//! not delay small ones of another.

use std::collections::{HashMap, VecDeque};
use std::net::SocketAddr;

use super::{Datagram, LocalWriter};
use crate::fragments::{self, FRAGMENT};
use crate::wire::{self, DataFragHead, DatagramWriter, InlineQos};
use crate::writer::{CacheChange, SendItem, WriterState};
use crate::{EntityId, GuidPrefix, SequenceNumber};

/// Maximum size of the headers of a datagram with one fragment, in bytes.
const HEADERS: usize = 160;

#[derive(Debug, Default)]
struct WriterQueue {
    waiting: VecDeque<SendItem>,
    /// The sample being sent. It is kept until its last fragment was sent, even if its writer has dropped it: otherwise
    /// a receiver would never get a complete sample from a fast sender.
    current: Option<(SendItem, CacheChange)>,
}

impl WriterQueue {
    /// Makes the next sample current, if its reader may be sent it now.
    fn prepare(&mut self, to: SocketAddr, state: &WriterState) {
        if self.current.is_some() {
            return;
        }
        // Dropped samples are skipped; readers that miss them are told when they ask.
        self.waiting.retain(|item| state.change(item.number).is_some());
        // Samples that were started are repaired before another one is started.
        let full = state.is_window_full(to);
        let small = |item: &SendItem| item.last == 0 && item.reader != EntityId::UNKNOWN;
        let next = self.waiting.iter().position(|item| !full || small(item) || state.is_started(item.number));
        let Some(item) = next.and_then(|at| self.waiting.remove(at)) else {
            return;
        };
        let change = state.change(item.number);
        self.current = change.map(|change| (item, change.clone()));
    }
}

/// State of the send queue of an address.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum SendReadiness {
    /// A datagram of about this length is ready; whether a reader has requested it again.
    Length(usize, bool),
    /// The path is blocked until a reader acknowledges something.
    Held,
    /// The queue is empty.
    Empty,
}

/// The send queue of one address.
#[derive(Debug, Default)]
pub(super) struct DestinationQueue {
    turns: VecDeque<EntityId>,
    queues: HashMap<EntityId, WriterQueue>,
}

impl DestinationQueue {
    pub fn push(&mut self, item: SendItem) {
        let queue = self.queues.entry(item.writer).or_insert_with(|| {
            self.turns.push_back(item.writer);
            WriterQueue::default()
        });
        let same = |other: &SendItem| {
            other.number == item.number && (other.reader == item.reader || other.reader == EntityId::UNKNOWN)
        };
        // A repeated request for a queued sample is not queued twice. Neither is one for the sample being sent: what
        // the receiver misses has not been sent or not been read there, and it is asked again with the last fragment.
        let covers = |waiting: &SendItem| same(waiting) && waiting.next <= item.next && waiting.last >= item.last;
        let again = item.reader != EntityId::UNKNOWN;
        let under_way = |(current, _): &(SendItem, CacheChange)| same(current);
        let waits = again && (queue.waiting.iter().any(covers) || queue.current.as_ref().is_some_and(under_way));
        if !waits {
            queue.waiting.push_back(item);
        }
    }

    /// Returns whether anything of this writer is queued.
    pub fn has_pending(&self, writer: EntityId) -> bool {
        self.queues.get(&writer).is_some_and(|queue| queue.current.is_some() || !queue.waiting.is_empty())
    }

    /// Returns the sample of this writer of which some but not all fragments were sent.
    pub fn in_flight_number(&self, writer: EntityId) -> Option<SequenceNumber> {
        let (item, _) = self.queues.get(&writer)?.current.as_ref()?;
        Some(item.number)
    }

    pub fn forget(&mut self, writer: EntityId) {
        self.queues.remove(&writer);
        self.turns.retain(|turn| *turn != writer);
    }

    /// Prepares the next datagram for this address.
    pub fn prepare(&mut self, to: SocketAddr, writers: &HashMap<EntityId, LocalWriter>) -> SendReadiness {
        let mut held = 0;
        while let Some(writer) = self.turns.front().copied() {
            if held == self.turns.len() {
                return SendReadiness::Held;
            }
            let Some(queue) = self.queues.get_mut(&writer) else {
                self.turns.pop_front();
                continue;
            };
            if let Some(state) = writers.get(&writer).map(|writer| &writer.state) {
                queue.prepare(to, state);
            } else {
                queue.waiting.clear();
            }
            match &queue.current {
                Some((item, change)) => {
                    let length = change.payload.len().min(FRAGMENT) + HEADERS;
                    return SendReadiness::Length(length, item.reader != EntityId::UNKNOWN);
                }
                None if queue.waiting.is_empty() => self.forget(writer),
                None => {
                    held += 1;
                    self.turns.rotate_left(1);
                }
            }
        }
        SendReadiness::Empty
    }

    /// Returns the prepared datagram. What must follow it immediately is put into `control`.
    pub fn next_datagram(
        &mut self,
        to: SocketAddr,
        from: GuidPrefix,
        writers: &mut HashMap<EntityId, LocalWriter>,
        control: &mut VecDeque<Datagram>,
    ) -> Option<Datagram> {
        let writer = self.turns.pop_front()?;
        self.turns.push_back(writer);
        let queue = self.queues.get_mut(&writer)?;
        let (mut item, change) = queue.current.take()?;
        let mut state = writers.get_mut(&writer).map(|writer| &mut writer.state);
        if let Some(state) = state.as_mut().filter(|_| item.last != 0) {
            state.mark_started(item.number, to);
        }
        // Reliable readers are asked for an acknowledgement with the last fragment of each sample.
        let heartbeat =
            state.filter(|state| item.next == item.last && state.needs_ack(to)).map(|state| wire::Heartbeat {
                reader: item.reader,
                writer,
                first: state.relevant_from(to),
                last: state.last().min(item.number).max(state.relevant_from(to)),
                count: state.count_heartbeat(),
                is_final: false,
                liveliness: false,
            });
        let heartbeat = heartbeat.filter(|beat| beat.first <= beat.last);
        let inline = InlineQos { related: change.related, status: change.status, key_hash: change.key };
        let mut datagram = DatagramWriter::new(from);
        datagram.destination(item.prefix);
        datagram.timestamp(change.written);
        if item.last == 0 {
            datagram.data(&wire::Data {
                reader: item.reader,
                writer,
                number: item.number,
                inline,
                payload: Some(change.payload.clone()),
                key_only: change.status != 0,
            });
            if let Some(beat) = &heartbeat {
                datagram.heartbeat(beat);
            }
            return Some(Datagram::from_writer(to, datagram));
        }
        let start = (item.next as usize - 1) * FRAGMENT;
        let body = change.payload.slice(start..change.payload.len().min(start + FRAGMENT));
        let fragment = DataFragHead {
            reader: item.reader,
            writer,
            number: item.number,
            inline,
            first: item.next,
            count: 1,
            fragment_size: FRAGMENT as u16,
            sample_size: change.payload.len() as u32,
        };
        let tail = datagram.data_frag_head(&fragment, body.len());
        let head = datagram.finish();
        if let Some(beat) = &heartbeat {
            let mut datagram = DatagramWriter::new(from);
            datagram.destination(item.prefix);
            datagram.heartbeat(beat);
            control.push_front(Datagram::from_writer(to, datagram));
        }
        debug_assert!(item.last <= fragments::fragment_count(change.payload.len()));
        if item.next < item.last {
            item.next += 1;
            queue.current = Some((item, change));
        }
        Some(Datagram { to, head, body, tail })
    }
}
