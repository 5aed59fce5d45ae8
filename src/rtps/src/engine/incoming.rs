//! Received datagrams: passes each submessage to the endpoints that it is for.

use std::net::IpAddr;
use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;

use super::{Engine, LocalReader};
use crate::discovery;
use crate::shared::ReceivedSample;
use crate::wire::{self, ReceivedSubmessage, Submessage};
use crate::writer::SendRequests;
use crate::{EntityId, Guid, GuidPrefix};

impl Engine {
    /// Handles a datagram received from this address.
    pub fn receive(&mut self, now: Instant, source: IpAddr, datagram: &Bytes) {
        if self.alone {
            return;
        }
        let parsed = wire::parse(datagram);
        if let Some(fault) = parsed.fault {
            tracing::trace!(%fault, "an RTPS datagram was not read completely");
        }
        for received in parsed.received {
            // Any message shows that the sender is alive.
            if let Some(remote) = self.remotes.get_mut(&received.from) {
                remote.heard = now;
                remote.asked = None;
            }
            let other = received.to.is_some_and(|to| to != self.own.prefix && to != GuidPrefix::UNKNOWN);
            if !other && received.from != self.own.prefix {
                self.receive_submessage(now, source, received);
            }
        }
        self.publish_changes();
    }

    fn receive_submessage(&mut self, now: Instant, source: IpAddr, received: ReceivedSubmessage) {
        let ReceivedSubmessage { from, vendor: _, written, submessage, .. } = received;
        match submessage {
            Submessage::Data(data) if data.writer == EntityId::SPDP_WRITER && !self.is_client() => {
                self.on_participant_data(now, from, source, &data)
            }
            Submessage::Data(data) => {
                if data.writer == EntityId::SPDP_WRITER {
                    self.on_server_announcement(now, from, source, &data);
                }
                let writer = Guid::new(from, data.writer);
                let withdrawn = (data.inline.status != 0).then(|| discovery::guid_of_key(&data)).flatten();
                let is_sample = data.payload.is_some() && !data.key_only && data.inline.status == 0;
                self.deliver_to_readers(now, data.reader, writer, |reader, out| {
                    if is_sample || (reader.sink.is_none() && withdrawn.is_some()) {
                        let sample = ReceivedSample {
                            payload: data.payload.clone().unwrap_or_default(),
                            writer,
                            number: data.number,
                            related: data.inline.related,
                            written,
                            withdrawn,
                        };
                        reader.state.on_data(now, writer, sample, out)
                    } else {
                        reader.state.skip_sample(writer, data.number, out);
                        false
                    }
                });
            }
            Submessage::DataFrag(frag) => {
                let writer = Guid::new(from, frag.writer);
                if !frag.key_only {
                    self.deliver_to_readers(now, frag.reader, writer, |reader, out| {
                        reader.state.on_data_frag(now, writer, &frag, written, out)
                    });
                }
            }
            Submessage::Heartbeat(beat) => {
                let writer = Guid::new(from, beat.writer);
                self.deliver_to_readers(now, beat.reader, writer, |reader, out| {
                    reader.state.on_heartbeat(now, writer, &beat, out)
                });
            }
            Submessage::HeartbeatFrag(beat) => {
                let writer = Guid::new(from, beat.writer);
                self.deliver_to_readers(now, beat.reader, writer, |reader, _| {
                    reader.state.on_heartbeat_frag(now, writer, &beat);
                    false
                });
            }
            Submessage::Gap(gap) => {
                let writer = Guid::new(from, gap.writer);
                self.deliver_to_readers(now, gap.reader, writer, |reader, out| {
                    reader.state.on_gap(writer, &gap, out);
                    false
                });
            }
            Submessage::AckNack(ack) => {
                let mut wanted = SendRequests::default();
                let reader = Guid::new(from, ack.reader);
                self.on_server_acknack(now, reader, ack.writer, &ack.set);
                if let Some(writer) = self.writers.get_mut(&ack.writer) {
                    if writer.state.on_acknack(now, reader, &ack.set, ack.count, ack.is_final, &mut wanted) {
                        self.changed_ends.insert(ack.writer);
                    }
                    let ask_at = writer.state.next_heartbeat_at();
                    self.enqueue(ack.writer, wanted);
                    self.tick_at = self.tick_at.min(ask_at.unwrap_or(self.tick_at));
                }
            }
            Submessage::NackFrag(nack) => {
                let mut wanted = SendRequests::default();
                let reader = Guid::new(from, nack.reader);
                if let Some(writer) = self.writers.get_mut(&nack.writer) {
                    writer.state.on_nack_frag(now, reader, nack.number, &nack.set, nack.count, &mut wanted);
                    self.enqueue(nack.writer, wanted);
                }
            }
        }
    }

    /// Passes something from a writer to one reader, or to all for `UNKNOWN`. `take` returns whether it shows for the
    /// first time that the writer knows the reader.
    fn deliver_to_readers(
        &mut self,
        now: Instant,
        entity: EntityId,
        writer: Guid,
        mut take: impl FnMut(&mut LocalReader, &mut Vec<ReceivedSample>) -> bool,
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
                Some(sink) => self.deliveries.extend(out.into_iter().map(|sample| (Arc::clone(sink), sample))),
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
            self.on_announcement(now, entity, &sample);
        }
    }
}
