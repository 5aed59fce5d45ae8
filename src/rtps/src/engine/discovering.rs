//! Discovery: participants announce themselves (8.5.3), and their endpoints to known participants (8.5.4).

use std::collections::BTreeSet;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use tokio::sync::watch;

use super::servers::{DiscoverySource, SPARE};
use super::{Datagram, Engine, LocalReader, LocalWriter, RemoteParticipant};
use crate::discovery::{self, EndpointData, ParticipantData};
use crate::reader::ReaderState;
use crate::shared::{DiscoveredGraph, ReceivedSample};
use crate::wire::{self, InlineQos};
use crate::writer::{CacheChange, WriterState};
use crate::{EntityId, Guid, GuidPrefix, SequenceNumber};

/// First pause between two announcements; each pause is twice as long as the one before.
pub(super) const FIRST_PAUSE: Duration = Duration::from_millis(20);
/// Longest pause between two announcements: a third of the announced lease duration.
pub(super) const LAST_PAUSE: Duration = Duration::from_secs(3);
/// Pause before an announcement is repeated to a newcomer, whose port may be bound before anybody reads it.
const TOLD_AGAIN: Duration = Duration::from_millis(50);
/// Maximum number of participants and of endpoints that are kept.
pub(super) const MOST_PARTICIPANTS: usize = 256;
pub(super) const MOST_ENDS: usize = 16_384;
/// Maximum number of disposals of endpoints kept for newcomers.
const MOST_WITHDRAWN: usize = 64;

pub(super) const DISPOSED: u32 = InlineQos::DISPOSED | InlineQos::UNREGISTERED;

/// Writer and reader with which a discovery server and its clients announce participants.
pub(super) const PARTICIPANTS: (EntityId, EntityId) = (EntityId::SPDP_WRITER, EntityId::SPDP_READER);

/// Writers and readers with which endpoints are announced.
pub(super) const ANNOUNCERS: [(EntityId, EntityId); 2] = [
    (EntityId::PUBLICATIONS_WRITER, EntityId::PUBLICATIONS_READER),
    (EntityId::SUBSCRIPTIONS_WRITER, EntityId::SUBSCRIPTIONS_READER),
];

/// Bits of `PID_BUILTIN_ENDPOINT_SET` for the writers and the readers of endpoint announcements (9.3.2.12).
pub(super) const ANNOUNCES: [u32; 2] = [1 << 2, 1 << 4];
pub(super) const HEARS: [u32; 2] = [1 << 3, 1 << 5];
/// Built-in endpoints of our participants.
pub(crate) const BUILTIN: u32 = 0x3f;

impl Engine {
    pub(super) fn add_builtin_endpoints(&mut self) {
        for pair in ANNOUNCERS {
            self.add_builtin_pair(pair);
        }
    }

    /// Adds a built-in writer and the corresponding reader.
    pub(super) fn add_builtin_pair(&mut self, (writer, reader): (EntityId, EntityId)) {
        let own = builtin_endpoint(self.own.prefix, writer);
        self.writers.insert(
            writer,
            LocalWriter { state: WriterState::new(own), ends: watch::Sender::new(Arc::default()), leaves: None },
        );
        let state = ReaderState::new(builtin_endpoint(self.own.prefix, reader), self.bounds.clone());
        self.readers.insert(reader, LocalReader { state, ends: watch::Sender::new(Arc::default()), sink: None });
    }

    // ---- local participant

    /// Sends announcements that are due and removes participants whose lease has expired; returns the time of the next
    /// call.
    pub(super) fn tick_discovery(&mut self, now: Instant) -> Instant {
        if self.announce_at <= now && !self.closed {
            self.predecessors.remove_expired(now);
            self.announce();
            self.ping_silent(now);
            self.repeat_unconfirmed(now);
            self.announce_at = now + self.announce_pause;
            self.announce_pause = (self.announce_pause * 2).min(self.longest_pause());
        }
        let gone = |remote: &RemoteParticipant| {
            let silent = |since: Instant| now.saturating_duration_since(since);
            remote.data.lease.is_some_and(|lease| match remote.via {
                DiscoverySource::Itself(_) | DiscoverySource::Named(_) => silent(remote.heard) > lease,
                DiscoverySource::Servers => remote.asked.is_some_and(|at| silent(at) > lease + SPARE),
            })
        };
        let silent: Vec<GuidPrefix> =
            self.remotes.iter().filter(|(_, remote)| gone(remote)).map(|(prefix, _)| *prefix).collect();
        for prefix in silent {
            self.remove_participant(prefix);
        }
        self.announce_at.min(now + LAST_PAUSE)
    }

    /// Announces more often for a while, because a participant may have appeared.
    pub(super) fn announce_soon(&mut self, now: Instant) {
        self.announce_pause = FIRST_PAUSE;
        self.announce_at = self.announce_at.min(now + TOLD_AGAIN);
        self.wake(self.announce_at);
    }

    fn announce(&mut self) {
        if self.is_client() {
            self.announce_to_servers();
            return;
        }
        let known = self.remotes.values().map(|remote| (remote.discovery, remote.data.prefix));
        let unknown = self.announce_to.iter().map(|to| (*to, GuidPrefix::UNKNOWN));
        let ports = self.bound.iter().map(|at| (SocketAddr::V4(*at), GuidPrefix::UNKNOWN));
        let mut told = BTreeSet::new();
        let all: Vec<_> = known.chain(unknown).chain(ports).filter(|(to, _)| told.insert(*to)).collect();
        for (to, prefix) in all {
            self.send_announcement(to, prefix);
        }
    }

    /// Announces this participant to another one, or to whoever listens at the address.
    pub(super) fn send_announcement(&mut self, to: SocketAddr, prefix: GuidPrefix) {
        // Sent first, so that nobody sees both at the same time.
        self.dispose_predecessors(to, prefix);
        self.announcements += 1;
        let data = wire::Data {
            reader: EntityId::SPDP_READER,
            writer: EntityId::SPDP_WRITER,
            number: SequenceNumber(self.announcements),
            inline: InlineQos::default(),
            payload: Some(self.own.to_bytes()),
            key_only: false,
        };
        self.send_participant_data(self.own.prefix, to, prefix, &data);
    }

    /// Announces that a participant is gone: this one, or a predecessor that cannot do so any more.
    pub(super) fn send_disposal(
        &mut self,
        gone: GuidPrefix,
        number: SequenceNumber,
        to: SocketAddr,
        prefix: GuidPrefix,
    ) {
        let guid = Guid::new(gone, EntityId::PARTICIPANT);
        let data = wire::Data {
            reader: EntityId::SPDP_READER,
            writer: EntityId::SPDP_WRITER,
            number,
            inline: InlineQos { related: None, status: DISPOSED, key_hash: Some(guid.bytes()) },
            payload: Some(discovery::key_payload(guid)),
            key_only: true,
        };
        self.send_participant_data(gone, to, prefix, &data);
    }

    fn send_participant_data(&mut self, whose: GuidPrefix, to: SocketAddr, prefix: GuidPrefix, data: &wire::Data) {
        let mut writer = wire::DatagramWriter::new(whose);
        if prefix != GuidPrefix::UNKNOWN {
            writer.destination(prefix);
        }
        writer.timestamp(std::time::SystemTime::now().into());
        writer.data(data);
        self.control.push_back(Datagram::from_writer(to, writer));
    }

    pub(super) fn announce_departure(&mut self, now: Instant) {
        if self.is_client() {
            self.leave_servers(now);
            return;
        }
        let known: Vec<_> = self.remotes.values().map(|remote| (remote.discovery, remote.data.prefix)).collect();
        for (to, prefix) in known {
            self.announcements += 1;
            let number = SequenceNumber(self.announcements);
            self.send_disposal(self.own.prefix, number, to, prefix);
        }
    }

    // ---- remote participants

    /// Handles an announcement received from this address.
    pub(super) fn on_participant_data(&mut self, now: Instant, from: GuidPrefix, source: IpAddr, data: &wire::Data) {
        if data.inline.status != 0 {
            if let Some(guid) = discovery::guid_of_key(data) {
                self.remove_participant(guid.prefix);
            } else {
                self.remove_participant(from);
            }
            return;
        }
        let Some(payload) = &data.payload else {
            return;
        };
        let told = match ParticipantData::from_payload(payload) {
            Ok(told) => told,
            Err(error) => {
                tracing::debug!(%error, "an announcement of a DDS participant was not understood");
                return;
            }
        };
        let elsewhere = told.domain.is_some() && told.domain != self.own.domain;
        if told.prefix == self.own.prefix || told.prefix != from || elsewhere {
            return;
        }
        if let Some(remote) = self.remotes.get_mut(&from) {
            remote.heard = now;
            remote.via = DiscoverySource::Itself(source);
        }
        self.update_participant(now, DiscoverySource::Itself(source), told);
    }

    /// Handles a sample of a built-in writer.
    pub(super) fn on_announcement(&mut self, now: Instant, reader: EntityId, sample: &ReceivedSample) {
        if reader == EntityId::SPDP_READER {
            self.on_server_data(now, sample);
        } else {
            self.on_endpoint_data(now, reader, sample);
        }
    }

    /// Handles the announcement or disposal of an endpoint.
    fn on_endpoint_data(&mut self, now: Instant, reader: EntityId, sample: &ReceivedSample) {
        if let Some(gone) = sample.withdrawn {
            self.on_endpoint_lost(gone);
            return;
        }
        let told = match EndpointData::from_payload(&sample.payload) {
            Ok(told) => told,
            Err(error) => {
                tracing::debug!(%error, "an announcement of a DDS topic's end was not understood");
                return;
            }
        };
        let whose = told.guid.prefix;
        let told_by_server = self.is_server(sample.writer.prefix) && self.remotes.contains_key(&whose);
        let fits = (whose == sample.writer.prefix || told_by_server)
            && told.guid.entity.is_writer() == (reader == EntityId::PUBLICATIONS_READER)
            && !told.guid.entity.is_builtin();
        if !fits {
            return;
        }
        let DiscoveredGraph { writers, readers, .. } = &self.discovered;
        let known = writers.contains_key(&told.guid) || readers.contains_key(&told.guid);
        if !known && writers.len() + readers.len() >= MOST_ENDS {
            if !std::mem::replace(&mut self.crowded, true) {
                tracing::warn!(
                    "more than {MOST_ENDS} DDS writers and readers; that of topic {} and further ones are ignored",
                    told.topic
                );
            }
            return;
        }
        self.on_endpoint_discovered(now, Arc::new(told));
    }

    // ---- local endpoints

    pub(super) fn announce_endpoint(&mut self, now: Instant, own: &EndpointData) {
        self.publish_announcement(now, own.guid.entity, own.to_bytes());
    }

    /// Publishes the announcement of a local endpoint or of the participant.
    pub(super) fn publish_announcement(&mut self, now: Instant, entity: EntityId, payload: Bytes) {
        let announcer = announcing_writer(entity);
        let number = self.publish(now, announcer, Engine::announcement_change(payload));
        // Newcomers need only the latest announcement.
        if let Some(before) = self.announced.insert(entity, number) {
            if let Some(writer) = self.writers.get_mut(&announcer) {
                writer.state.forget(before);
            }
        }
        self.wake(now);
    }

    pub(super) fn withdraw_endpoint(&mut self, now: Instant, entity: EntityId) {
        let Some(number) = self.announced.remove(&entity) else {
            return;
        };
        let announcer = announcing_writer(entity);
        let guid = Guid::new(self.own.prefix, entity);
        let change = CacheChange {
            status: DISPOSED,
            key: Some(guid.bytes()),
            ..Engine::announcement_change(discovery::key_payload(guid))
        };
        let withdrawal = self.publish(now, announcer, change);
        self.withdrawn.push_back((announcer, withdrawal));
        let old = (self.withdrawn.len() > MOST_WITHDRAWN).then(|| self.withdrawn.pop_front()).flatten();
        for (announcer, number) in [Some((announcer, number)), old].into_iter().flatten() {
            if let Some(writer) = self.writers.get_mut(&announcer) {
                writer.state.forget(number);
            }
        }
        self.wake(now);
    }
}

fn announcing_writer(entity: EntityId) -> EntityId {
    if entity == EntityId::PARTICIPANT {
        EntityId::SPDP_WRITER
    } else if entity.is_writer() {
        EntityId::PUBLICATIONS_WRITER
    } else {
        EntityId::SUBSCRIPTIONS_WRITER
    }
}

/// Returns the data of a built-in endpoint.
pub(super) fn builtin_endpoint(prefix: GuidPrefix, entity: EntityId) -> EndpointData {
    EndpointData {
        guid: Guid::new(prefix, entity),
        topic: String::new(),
        type_name: String::new(),
        qos: Engine::builtin_qos(),
        user_data: Bytes::new(),
        unicast: Vec::new(),
        expects_inline_qos: false,
    }
}
