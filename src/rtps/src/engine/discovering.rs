//! Who is there: participants announce themselves (8.5.3), and their ends to those that they know (8.5.4).

use std::collections::BTreeSet;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use tokio::sync::watch;

use super::servers::{SPARE, Via};
use super::{Datagram, Engine, LocalReader, LocalWriter, Remote};
use crate::discovery::{self, EndpointData, ParticipantData};
use crate::participant::{Discovered, Sample};
use crate::reader::ReaderState;
use crate::wire::{self, InlineQos};
use crate::writer::{Change, WriterState};
use crate::{EntityId, Guid, GuidPrefix, SequenceNumber};

/// The first pause between two announcements; each is twice as long as the one before.
pub(super) const FIRST_PAUSE: Duration = Duration::from_millis(20);
/// Announcements never come more seldom: a third of the lease that is told.
pub(super) const LAST_PAUSE: Duration = Duration::from_secs(3);
/// How often a newcomer's port is told of us: its socket may be there before whoever reads it.
const TOLD_AGAIN: Duration = Duration::from_millis(50);
/// More participants, and more ends of each, are not kept.
pub(super) const MOST_PARTICIPANTS: usize = 256;
pub(super) const MOST_ENDS: usize = 16_384;
/// Ends that were taken back are told to newcomers, but not for ever.
const MOST_WITHDRAWN: usize = 64;

pub(super) const DISPOSED: u32 = InlineQos::DISPOSED | InlineQos::UNREGISTERED;

/// The pair of ends by which a server of discovery and its clients announce participants.
pub(super) const PARTICIPANTS: (EntityId, EntityId) =
    (EntityId::SPDP_WRITER, EntityId::SPDP_READER);

/// The pairs of ends by which ends are announced: who writes, and who reads.
pub(super) const ANNOUNCERS: [(EntityId, EntityId); 2] = [
    (EntityId::PUBLICATIONS_WRITER, EntityId::PUBLICATIONS_READER),
    (
        EntityId::SUBSCRIPTIONS_WRITER,
        EntityId::SUBSCRIPTIONS_READER,
    ),
];

/// Bits of `PID_BUILTIN_ENDPOINT_SET`: who announces ends, and who hears of them (9.3.2.12).
pub(super) const ANNOUNCES: [u32; 2] = [1 << 2, 1 << 4];
pub(super) const HEARS: [u32; 2] = [1 << 3, 1 << 5];
/// What our participants have.
pub(crate) const BUILTIN: u32 = 0x3f;

impl Engine {
    pub(super) fn add_builtin_ends(&mut self) {
        for pair in ANNOUNCERS {
            self.add_builtin_pair(pair);
        }
    }

    /// Who announces something, and who hears of it.
    pub(super) fn add_builtin_pair(&mut self, (writer, reader): (EntityId, EntityId)) {
        let own = builtin(self.own.prefix, writer);
        self.writers.insert(
            writer,
            LocalWriter {
                state: WriterState::new(own),
                ends: watch::Sender::new(Arc::default()),
                leaves: None,
            },
        );
        let state = ReaderState::new(builtin(self.own.prefix, reader), self.bounds.clone());
        self.readers.insert(
            reader,
            LocalReader {
                state,
                ends: watch::Sender::new(Arc::default()),
                sink: None,
            },
        );
    }

    // ---- announcing ourselves

    /// Announces this participant where it is due, and lets those go of whom nothing was heard; when to come back.
    pub(super) fn tick_discovery(&mut self, now: Instant) -> Instant {
        if self.announce_at <= now && !self.closed {
            self.predecessors.tidy(now);
            self.announce();
            self.ask_silent(now);
            self.announce_at = now + self.announce_pause;
            self.announce_pause = (self.announce_pause * 2).min(self.longest_pause());
        }
        let gone = |remote: &Remote| {
            let silent = |since: Instant| now.saturating_duration_since(since);
            remote.data.lease.is_some_and(|lease| match remote.via {
                Via::Itself(_) | Via::Named(_) => silent(remote.heard) > lease,
                Via::Servers => remote.asked.is_some_and(|at| silent(at) > lease + SPARE),
            })
        };
        let silent: Vec<GuidPrefix> = self
            .remotes
            .iter()
            .filter(|(_, remote)| gone(remote))
            .map(|(prefix, _)| *prefix)
            .collect();
        for prefix in silent {
            self.participant_gone(prefix);
        }
        self.announce_at.min(now + LAST_PAUSE)
    }

    /// Announces more often for a while: somebody may have come.
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
        let known = self
            .remotes
            .values()
            .map(|remote| (remote.discovery, remote.data.prefix));
        let unknown = self.announce_to.iter().map(|to| (*to, GuidPrefix::UNKNOWN));
        let ports = self
            .bound
            .iter()
            .map(|at| (SocketAddr::V4(*at), GuidPrefix::UNKNOWN));
        let mut told = BTreeSet::new();
        let all: Vec<_> = known
            .chain(unknown)
            .chain(ports)
            .filter(|(to, _)| told.insert(*to))
            .collect();
        for (to, prefix) in all {
            self.announce_to(to, prefix);
        }
    }

    /// Tells a participant, or whoever hears it there, of this one.
    pub(super) fn announce_to(&mut self, to: SocketAddr, prefix: GuidPrefix) {
        // First, so that nobody sees both at a time.
        self.say_goodbye_of_predecessors(to, prefix);
        self.announcements += 1;
        let data = wire::Data {
            reader: EntityId::SPDP_READER,
            writer: EntityId::SPDP_WRITER,
            number: SequenceNumber(self.announcements),
            inline: InlineQos::default(),
            payload: Some(self.own.to_bytes()),
            key_only: false,
        };
        self.tell_of(self.own.prefix, to, prefix, &data);
    }

    /// Says to them that a participant is gone: this one, or one that cannot say it any more.
    pub(super) fn say_gone(
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
            inline: InlineQos {
                related: None,
                status: DISPOSED,
                key_hash: Some(guid.bytes()),
            },
            payload: Some(discovery::key(guid)),
            key_only: true,
        };
        self.tell_of(gone, to, prefix, &data);
    }

    fn tell_of(
        &mut self,
        whose: GuidPrefix,
        to: SocketAddr,
        prefix: GuidPrefix,
        data: &wire::Data,
    ) {
        let mut writer = wire::DatagramWriter::new(whose);
        if prefix != GuidPrefix::UNKNOWN {
            writer.destination(prefix);
        }
        writer.timestamp(std::time::SystemTime::now().into());
        writer.data(data);
        self.control.push_back(Datagram::whole(to, writer));
    }

    pub(super) fn say_goodbye(&mut self, now: Instant) {
        if self.is_client() {
            self.leave_servers(now);
            return;
        }
        let known: Vec<_> = self
            .remotes
            .values()
            .map(|remote| (remote.discovery, remote.data.prefix))
            .collect();
        for (to, prefix) in known {
            self.announcements += 1;
            let number = SequenceNumber(self.announcements);
            self.say_gone(self.own.prefix, number, to, prefix);
        }
    }

    // ---- others

    /// A participant announces itself, from this address.
    pub(super) fn participant_heard(
        &mut self,
        now: Instant,
        from: GuidPrefix,
        source: IpAddr,
        data: &wire::Data,
    ) {
        if data.inline.status != 0 {
            if let Some(guid) = discovery::guid_of_key(data) {
                self.participant_gone(guid.prefix);
            } else {
                self.participant_gone(from);
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
            remote.via = Via::Itself(source);
        }
        self.participant_told(now, Via::Itself(source), told);
    }

    /// Something came from one of the protocol's own writers.
    pub(super) fn announced(&mut self, now: Instant, reader: EntityId, sample: &Sample) {
        if reader == EntityId::SPDP_READER {
            self.server_tells(now, sample);
        } else {
            self.end_heard(now, reader, sample);
        }
    }

    /// An end, or that one is gone.
    fn end_heard(&mut self, now: Instant, reader: EntityId, sample: &Sample) {
        if let Some(gone) = sample.withdrawn {
            self.end_gone(gone);
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
        let told_by_server =
            self.is_server(sample.writer.prefix) && self.remotes.contains_key(&whose);
        let fits = (whose == sample.writer.prefix || told_by_server)
            && told.guid.entity.is_writer() == (reader == EntityId::PUBLICATIONS_READER)
            && !told.guid.entity.is_builtin();
        if !fits {
            return;
        }
        let Discovered {
            writers, readers, ..
        } = &self.discovered;
        let known = writers.contains_key(&told.guid) || readers.contains_key(&told.guid);
        if !known && writers.len() + readers.len() >= MOST_ENDS {
            if !std::mem::replace(&mut self.crowded, true) {
                tracing::warn!(
                    "more than {MOST_ENDS} DDS writers and readers; that of topic {} is not heard, nor are others",
                    told.topic
                );
            }
            return;
        }
        self.end_came(now, Arc::new(told));
    }

    // ---- our ends

    pub(super) fn announce_end(&mut self, now: Instant, own: &EndpointData) {
        self.announce_as(now, own.guid.entity, own.to_bytes());
    }

    /// Announces an end of ours, or the participant.
    pub(super) fn announce_as(&mut self, now: Instant, entity: EntityId, payload: Bytes) {
        let announcer = announcer(entity);
        let number = self.publish(now, announcer, Engine::change_of_announcement(payload));
        // Of what was announced before, newcomers need the last word alone.
        if let Some(before) = self.announced.insert(entity, number) {
            if let Some(writer) = self.writers.get_mut(&announcer) {
                writer.state.forget(before);
            }
        }
        self.wake(now);
    }

    pub(super) fn withdraw_end(&mut self, now: Instant, entity: EntityId) {
        let Some(number) = self.announced.remove(&entity) else {
            return;
        };
        let announcer = announcer(entity);
        let guid = Guid::new(self.own.prefix, entity);
        let change = Change {
            status: DISPOSED,
            key: Some(guid.bytes()),
            ..Engine::change_of_announcement(discovery::key(guid))
        };
        let withdrawal = self.publish(now, announcer, change);
        self.withdrawn.push_back((announcer, withdrawal));
        let old = (self.withdrawn.len() > MOST_WITHDRAWN)
            .then(|| self.withdrawn.pop_front())
            .flatten();
        for (announcer, number) in [Some((announcer, number)), old].into_iter().flatten() {
            if let Some(writer) = self.writers.get_mut(&announcer) {
                writer.state.forget(number);
            }
        }
        self.wake(now);
    }
}

fn announcer(entity: EntityId) -> EntityId {
    if entity == EntityId::PARTICIPANT {
        EntityId::SPDP_WRITER
    } else if entity.is_writer() {
        EntityId::PUBLICATIONS_WRITER
    } else {
        EntityId::SUBSCRIPTIONS_WRITER
    }
}

/// One of the protocol's own ends.
pub(super) fn builtin(prefix: GuidPrefix, entity: EntityId) -> EndpointData {
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
