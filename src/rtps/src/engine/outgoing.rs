//! What goes out: answers of readers and questions of writers at once, samples when their receivers have room.

use std::net::SocketAddr;

use super::paths::Prepared;
use super::{Datagram, Engine};
use crate::reader::Answer;
use crate::sequence::SequenceSet;
use crate::wire::{self, DatagramWriter, Submessage};
use crate::writer::Wanted;
use crate::{EntityId, GuidPrefix};

impl Engine {
    pub(super) fn answer(&mut self, answer: Answer) {
        let mut writer = self.datagram(answer.prefix);
        writer.acknack(&answer.acknack);
        for nack in &answer.nack_frags {
            writer.nack_frag(nack);
        }
        self.control.push_back(Datagram::whole(answer.to, writer));
    }

    pub(super) fn datagram(&self, to: GuidPrefix) -> DatagramWriter {
        let mut writer = DatagramWriter::new(self.own.prefix);
        writer.destination(to);
        writer
    }

    /// Lines up what a writer wants sent.
    pub(super) fn enqueue(&mut self, entity: EntityId, wanted: Wanted) {
        for (to, item) in wanted.items {
            self.paths.entry(to).or_default().push(item);
        }
        let Some(writer) = self.writers.get_mut(&entity) else {
            return;
        };
        let last = writer.state.last();
        let mut out = Vec::new();
        for (to, reader, first, asks) in wanted.heartbeats {
            // What is being sent is not gone, though a newer sample has taken its place here.
            let under_way = self.paths.get(&to).and_then(|path| path.sending(entity));
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
            // Its sample was given up, and is still being sent: it will be whole. Fast DDS 2.14 never gets over a word that there
            // is none of a sample of which it has fragments: whoever takes from that reader then tries for ever.
            let under_way = self.paths.get(&to).and_then(|path| path.sending(entity));
            if under_way.is_some_and(|number| (start..end).contains(&number)) {
                continue;
            }
            let gap = wire::Gap {
                reader: reader.entity,
                writer: entity,
                start,
                set: SequenceSet::empty(end),
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
    /// have room. `room` tells whether there is some for a datagram of so many bytes, which its receiver has asked
    /// for or not.
    pub fn transmit(
        &mut self,
        room: &mut dyn FnMut(SocketAddr, usize, bool) -> bool,
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
            let (length, again) = match path.prepare(to, &self.writers) {
                Prepared::Length(length, again) => (length, again),
                Prepared::Held => continue,
                Prepared::Empty => {
                    self.paths.remove(&to);
                    continue;
                }
            };
            if !room(to, length, again) {
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
}
