//! What waits to be sent to one address: one queue for each writer, served in turn, so that a large sample of one does not keep
//! the small ones of another waiting.

use std::collections::{HashMap, VecDeque};
use std::net::SocketAddr;

use super::{Datagram, LocalWriter};
use crate::fragments::{self, FRAGMENT};
use crate::wire::{self, DataFragHead, DatagramWriter, InlineQos};
use crate::writer::{Change, Item};
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
        // What is asked for again and waits already is not sent twice.
        let covers = |waiting: &Item| {
            waiting.number == item.number
                && (waiting.reader == item.reader || waiting.reader == EntityId::UNKNOWN)
                && waiting.next <= item.next
                && waiting.last >= item.last
        };
        let again = item.reader != EntityId::UNKNOWN;
        let waits = again
            && (queue.waiting.iter().any(covers)
                || queue
                    .current
                    .as_ref()
                    .is_some_and(|(current, _)| covers(current)));
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

    /// Makes the next item ready; about how long its datagram will be. None where nothing waits.
    pub fn prepare(&mut self, writers: &HashMap<EntityId, LocalWriter>) -> Option<usize> {
        while let Some(writer) = self.turns.front().copied() {
            let queue = self.queues.get_mut(&writer)?;
            while queue.current.is_none() {
                let Some(item) = queue.waiting.pop_front() else {
                    break;
                };
                // What was given up meanwhile is passed over; who misses it is told when it asks.
                let change = writers
                    .get(&writer)
                    .and_then(|writer| writer.state.change(item.number));
                queue.current = change.map(|change| (item, change.clone()));
            }
            match &queue.current {
                Some((_, change)) => return Some(change.payload.len().min(FRAGMENT) + HEADERS),
                None => self.forget(writer),
            }
        }
        None
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
        let state = writers.get_mut(&writer).map(|writer| &mut writer.state);
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
