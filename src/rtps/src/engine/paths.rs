//! What waits to be sent to one address: one queue for each writer, served in turn, so that a large sample of one does not keep
//! the small ones of another waiting.

use std::collections::{HashMap, VecDeque};
use std::net::SocketAddr;

use super::{Datagram, LocalWriter};
use crate::fragments::{self, FRAGMENT};
use crate::wire::{self, DataFragHead, DatagramWriter, InlineQos};
use crate::writer::{Change, Item, WriterState};
use crate::{EntityId, GuidPrefix, SequenceNumber};

/// What the headers of a datagram with one fragment take, at most, in bytes.
const HEADERS: usize = 160;

#[derive(Debug, Default)]
struct Queue {
    waiting: VecDeque<Item>,
    /// What is being sent. It is kept until its last fragment is out, even where its writer has given it up: a receiver whose
    /// sender always begins anew would never have a whole sample.
    current: Option<(Item, Change)>,
}

impl Queue {
    /// Takes the next sample, where its reader may be sent it now.
    fn prepare(&mut self, to: SocketAddr, state: &WriterState) {
        if self.current.is_some() {
            return;
        }
        // What was given up meanwhile is passed over; who misses it is told when it asks.
        self.waiting
            .retain(|item| state.change(item.number).is_some());
        // What was begun is repaired before anything else is begun.
        let full = state.is_window_full(to);
        let small = |item: &Item| item.last == 0 && item.reader != EntityId::UNKNOWN;
        let next = self
            .waiting
            .iter()
            .position(|item| !full || small(item) || state.is_begun(item.number));
        let Some(item) = next.and_then(|at| self.waiting.remove(at)) else {
            return;
        };
        let change = state.change(item.number);
        self.current = change.map(|change| (item, change.clone()));
    }
}

/// What is to be sent to one address next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Prepared {
    /// A datagram of about so many bytes, and whether a reader has asked for it.
    Length(usize, bool),
    /// Nothing until a reader has acknowledged something.
    Held,
    /// Nothing.
    Empty,
}

/// What waits for one address.
#[derive(Debug, Default)]
pub(super) struct Path {
    turns: VecDeque<EntityId>,
    queues: HashMap<EntityId, Queue>,
}

impl Path {
    pub fn push(&mut self, item: Item) {
        let queue = self.queues.entry(item.writer).or_insert_with(|| {
            self.turns.push_back(item.writer);
            Queue::default()
        });
        let same = |other: &Item| {
            other.number == item.number
                && (other.reader == item.reader || other.reader == EntityId::UNKNOWN)
        };
        // What is asked for again and waits already is not sent twice. Nor is what is under way: what a receiver misses of it is what has not
        // been sent, or has not been read there, and it is asked again with the last part.
        let covers = |waiting: &Item| {
            same(waiting) && waiting.next <= item.next && waiting.last >= item.last
        };
        let again = item.reader != EntityId::UNKNOWN;
        let under_way = |(current, _): &(Item, Change)| same(current);
        let waits = again
            && (queue.waiting.iter().any(covers) || queue.current.as_ref().is_some_and(under_way));
        if !waits {
            queue.waiting.push_back(item);
        }
    }

    /// Whether something of this writer waits.
    pub fn holds(&self, writer: EntityId) -> bool {
        self.queues
            .get(&writer)
            .is_some_and(|queue| queue.current.is_some() || !queue.waiting.is_empty())
    }

    /// The sample of this writer of which some fragments are out and others are not.
    pub fn sending(&self, writer: EntityId) -> Option<SequenceNumber> {
        let (item, _) = self.queues.get(&writer)?.current.as_ref()?;
        Some(item.number)
    }

    pub fn forget(&mut self, writer: EntityId) {
        self.queues.remove(&writer);
        self.turns.retain(|turn| *turn != writer);
    }

    /// Makes the next item ready for this address.
    pub fn prepare(
        &mut self,
        to: SocketAddr,
        writers: &HashMap<EntityId, LocalWriter>,
    ) -> Prepared {
        let mut held = 0;
        while let Some(writer) = self.turns.front().copied() {
            if held == self.turns.len() {
                return Prepared::Held;
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
                    return Prepared::Length(length, item.reader != EntityId::UNKNOWN);
                }
                None if queue.waiting.is_empty() => self.forget(writer),
                None => {
                    held += 1;
                    self.turns.rotate_left(1);
                }
            }
        }
        Prepared::Empty
    }

    /// The datagram of what was made ready. What has to follow it at once is put into `control`.
    pub fn next(
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
            state.begun(item.number, to);
        }
        // Whoever is to acknowledge is asked with the last part of each sample.
        let heartbeat = state
            .filter(|state| item.next == item.last && state.asks(to))
            .map(|state| wire::Heartbeat {
                reader: item.reader,
                writer,
                first: state.relevant_from(to),
                last: state.last().min(item.number).max(state.relevant_from(to)),
                count: state.count_heartbeat(),
                is_final: false,
                liveliness: false,
            });
        let heartbeat = heartbeat.filter(|beat| beat.first <= beat.last);
        let inline = InlineQos {
            related: change.related,
            status: change.status,
            key_hash: change.key,
        };
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
            return Some(Datagram::whole(to, datagram));
        }
        let start = (item.next as usize - 1) * FRAGMENT;
        let body = change
            .payload
            .slice(start..change.payload.len().min(start + FRAGMENT));
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
            control.push_front(Datagram::whole(to, datagram));
        }
        debug_assert!(item.last <= fragments::count(change.payload.len()));
        if item.next < item.last {
            item.next += 1;
            queue.current = Some((item, change));
        }
        Some(Datagram {
            to,
            head,
            body,
            tail,
        })
    }
}
