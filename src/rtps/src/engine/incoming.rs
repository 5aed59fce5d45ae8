//! What comes in: datagrams, each submessage to the ends that it is for.

use std::net::IpAddr;
use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;

use super::{Engine, LocalReader};
use crate::discovery;
use crate::participant::Sample;
use crate::wire::{self, Received, Submessage};
use crate::writer::Wanted;
use crate::{EntityId, Guid, GuidPrefix};

impl Engine {
    /// Takes a datagram that came from this address.
    pub fn receive(&mut self, now: Instant, source: IpAddr, datagram: &Bytes) {
        if self.alone {
            return;
        }
        let parsed = wire::parse(datagram);
        if let Some(fault) = parsed.fault {
            tracing::trace!(%fault, "a datagram of RTPS was not read to its end");
        }
        for received in parsed.received {
            // Whoever says anything is there.
            if let Some(remote) = self.remotes.get_mut(&received.from) {
                remote.heard = now;
                remote.asked = None;
            }
            let other = received
                .to
                .is_some_and(|to| to != self.own.prefix && to != GuidPrefix::UNKNOWN);
            if !other && received.from != self.own.prefix {
                self.receive_submessage(now, source, received);
            }
        }
        self.tell();
    }

    fn receive_submessage(&mut self, now: Instant, source: IpAddr, received: Received) {
        let Received {
            from,
            vendor: _,
            written,
            submessage,
            ..
        } = received;
        match submessage {
            Submessage::Data(data) if data.writer == EntityId::SPDP_WRITER && !self.is_client() => {
                self.participant_heard(now, from, source, &data)
            }
            Submessage::Data(data) => {
                if data.writer == EntityId::SPDP_WRITER {
                    self.server_heard(now, from, source, &data);
                }
                let writer = Guid::new(from, data.writer);
                let withdrawn = (data.inline.status != 0)
                    .then(|| discovery::guid_of_key(&data))
                    .flatten();
                let is_sample = data.payload.is_some() && !data.key_only && data.inline.status == 0;
                self.for_readers(now, data.reader, writer, |reader, out| {
                    if is_sample || (reader.sink.is_none() && withdrawn.is_some()) {
                        let sample = Sample {
                            payload: data.payload.clone().unwrap_or_default(),
                            writer,
                            number: data.number,
                            related: data.inline.related,
                            written,
                            withdrawn,
                        };
                        reader.state.data(now, writer, sample, out)
                    } else {
                        reader.state.nothing(writer, data.number, out);
                        false
                    }
                });
            }
            Submessage::DataFrag(frag) => {
                let writer = Guid::new(from, frag.writer);
                if !frag.key_only {
                    self.for_readers(now, frag.reader, writer, |reader, out| {
                        reader.state.data_frag(now, writer, &frag, written, out)
                    });
                }
            }
            Submessage::Heartbeat(beat) => {
                let writer = Guid::new(from, beat.writer);
                self.for_readers(now, beat.reader, writer, |reader, out| {
                    reader.state.heartbeat(now, writer, &beat, out)
                });
            }
            Submessage::HeartbeatFrag(beat) => {
                let writer = Guid::new(from, beat.writer);
                self.for_readers(now, beat.reader, writer, |reader, _| {
                    reader.state.heartbeat_frag(now, writer, &beat);
                    false
                });
            }
            Submessage::Gap(gap) => {
                let writer = Guid::new(from, gap.writer);
                self.for_readers(now, gap.reader, writer, |reader, out| {
                    reader.state.gap(writer, &gap, out);
                    false
                });
            }
            Submessage::AckNack(ack) => {
                let mut wanted = Wanted::default();
                let reader = Guid::new(from, ack.reader);
                self.server_acknowledges(now, reader, ack.writer, &ack.set);
                if let Some(writer) = self.writers.get_mut(&ack.writer) {
                    if writer.state.acknack(
                        now,
                        reader,
                        &ack.set,
                        ack.count,
                        ack.is_final,
                        &mut wanted,
                    ) {
                        self.changed_ends.insert(ack.writer);
                    }
                    let ask_at = writer.state.ask_at();
                    self.enqueue(ack.writer, wanted);
                    self.tick_at = self.tick_at.min(ask_at.unwrap_or(self.tick_at));
                }
            }
            Submessage::NackFrag(nack) => {
                let mut wanted = Wanted::default();
                let reader = Guid::new(from, nack.reader);
                if let Some(writer) = self.writers.get_mut(&nack.writer) {
                    writer.state.nack_frag(
                        now,
                        reader,
                        nack.number,
                        &nack.set,
                        nack.count,
                        &mut wanted,
                    );
                    self.enqueue(nack.writer, wanted);
                }
            }
        }
    }

    /// Has one reader, or all for `UNKNOWN`, take something of a writer. What `take` says is whether that shows for the first
    /// time that the writer knows the reader.
    fn for_readers(
        &mut self,
        now: Instant,
        entity: EntityId,
        writer: Guid,
        mut take: impl FnMut(&mut LocalReader, &mut Vec<Sample>) -> bool,
    ) {
        let mut announcements = Vec::new();
        let mut due = self.tick_at;
        let mut serve = |entity: EntityId, reader: &mut LocalReader| {
            let mut out = Vec::new();
            if take(reader, &mut out) {
                self.changed_ends.insert(entity);
            }
            due = due.min(reader.state.answer_at(writer).unwrap_or(due));
            match &reader.sink {
                Some(sink) => self
                    .deliveries
                    .extend(out.into_iter().map(|sample| (Arc::clone(sink), sample))),
                None => announcements.extend(out.into_iter().map(|sample| (entity, sample))),
            }
        };
        if entity == EntityId::UNKNOWN {
            for (entity, reader) in &mut self.readers {
                serve(*entity, reader);
            }
        } else if let Some(reader) = self.readers.get_mut(&entity) {
            serve(entity, reader);
        }
        self.tick_at = due;
        for (entity, sample) in announcements {
            self.announced(now, entity, &sample);
        }
    }
}
