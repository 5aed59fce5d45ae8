//! Outgoing datagrams: acknowledgements and heartbeats are sent immediately, samples when their receivers have room.

use std::net::SocketAddr;

use super::paths::SendReadiness;
use super::{Datagram, Engine};
use crate::reader::AckResponse;
use crate::sequence::SequenceSet;
use crate::wire::{self, DatagramWriter, Submessage};
use crate::writer::SendRequests;
use crate::{EntityId, GuidPrefix};

impl Engine {
    pub(super) fn send_ack(&mut self, answer: AckResponse) {
        let mut writer = self.new_datagram(answer.prefix);
        writer.acknack(&answer.acknack);
        for nack in &answer.nack_frags {
            writer.nack_frag(nack);
        }
        self.control.push_back(Datagram::from_writer(answer.to, writer));
    }

    pub(super) fn new_datagram(&self, to: GuidPrefix) -> DatagramWriter {
        let mut writer = DatagramWriter::new(self.own.prefix);
        writer.destination(to);
        writer
    }

    /// Queues what a writer requests to be sent.
    pub(super) fn enqueue(&mut self, entity: EntityId, wanted: SendRequests) {
        for (to, item) in wanted.items {
            self.paths.entry(to).or_default().push(item);
        }
        let Some(writer) = self.writers.get_mut(&entity) else {
            return;
        };
        let last = writer.state.last();
        let mut out = Vec::new();
        for (to, reader, first, asks) in wanted.heartbeats {
            // A sample in flight still exists, even if a newer one has replaced it in the history.
            let under_way = self.paths.get(&to).and_then(|path| path.in_flight_number(entity));
            let first = under_way.map_or(first, |number| first.min(number));
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
        for (to, reader, start, end) in wanted.gaps {
            // The sample was dropped from the history but is still being sent completely. Fast DDS 2.14 does not cope
            // with a GAP for a sample of which it has fragments: takes from that reader then never return.
            let under_way = self.paths.get(&to).and_then(|path| path.in_flight_number(entity));
            if under_way.is_some_and(|number| (start..end).contains(&number)) {
                continue;
            }
            let gap = wire::Gap { reader: reader.entity, writer: entity, start, set: SequenceSet::empty(end) };
            out.push((to, reader.prefix, Submessage::Gap(gap)));
        }
        for (to, prefix, submessage) in out {
            let mut writer = self.new_datagram(prefix);
            match &submessage {
                Submessage::Heartbeat(beat) => writer.heartbeat(beat),
                Submessage::Gap(gap) => writer.gap(gap),
                _ => continue,
            };
            self.control.push_back(Datagram::from_writer(to, writer));
        }
    }

    /// Returns the next datagram to send; `None` if there is none, or if all wait for room at their receivers. `room`
    /// returns whether a receiver has room for a datagram of this length, which it has requested again or not.
    pub fn transmit(&mut self, room: &mut dyn FnMut(SocketAddr, usize, bool) -> bool) -> Option<Datagram> {
        if let Some(datagram) = self.control.pop_front() {
            return Some(datagram);
        }
        // Round-robin over the addresses.
        let after = self.next_path;
        let order: Vec<SocketAddr> = match after {
            Some(after) => {
                let later = self.paths.range(after..).map(|(to, _)| *to).filter(|to| *to != after);
                let earlier = self.paths.range(..=after).map(|(to, _)| *to);
                later.chain(earlier).collect()
            }
            None => self.paths.keys().copied().collect(),
        };
        for to in order {
            let Some(path) = self.paths.get_mut(&to) else {
                continue;
            };
            let (length, again) = match path.prepare(to, &self.writers) {
                SendReadiness::Length(length, again) => (length, again),
                SendReadiness::Held => continue,
                SendReadiness::Empty => {
                    self.paths.remove(&to);
                    continue;
                }
            };
            if !room(to, length, again) {
                continue;
            }
            self.next_path = Some(to);
            if let Some(datagram) = path.next_datagram(to, self.own.prefix, &mut self.writers, &mut self.control) {
                return Some(datagram);
            }
        }
        None
    }
}
