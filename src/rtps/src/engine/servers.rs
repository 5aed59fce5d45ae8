//! Client of Fast DDS discovery servers, through which clients discover each other without multicast.
//!
//! ```text
//!   no server known ─▶ our announcement, repeated ─▶ the server announces itself ─▶ known
//!   known ─▶ our announcement and endpoints, reliably, each with its identity, by which other servers know it
//!         ◀─ those of all other participants, reliably; to these only samples are sent directly
//! ```
//! This is not standardized. The implementation follows Fast DDS 2.14, as observed on the wire and in its sources
//! (`PDPClient`, `PDPServer`, `DiscoveryDataBase`):
//! - Participants are announced by the same built-in endpoints as without servers, but reliably between a server and
//!   its clients.
//! - A server accepts only clients that claim to be Fast DDS (`PID_VENDOR_ID`), so ours does.
//! - `PARTICIPANT_TYPE` is the role of a participant. A server sends all participants to a `SUPER_CLIENT`, and to a
//!   `CLIENT` those with which it shares a topic.
//! - A restarted server has the same GUID prefix. It is detected by the loss of samples that it had acknowledged.

#![forbid(unsafe_code)]

#[cfg(test)]
mod tests;

use std::collections::BTreeSet;
use std::net::{IpAddr, SocketAddr, SocketAddrV4};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use super::discovering::{ANNOUNCERS, DISPOSED, LAST_PAUSE, PARTICIPANTS};
use super::{Datagram, Engine};
use crate::discovery::{self, EndpointData, ParticipantData};
use crate::locator::Locator;
use crate::sequence::SequenceSet;
use crate::shared::{DiscoveryServer, ReceivedSample};
use crate::wire::{self, InlineQos};
use crate::writer::{CacheChange, SendRequests};
use crate::{EntityId, Guid, GuidPrefix, SampleIdentity, SequenceNumber, VendorId};

/// Announcement interval for a server that is not there.
const MISSING: Duration = Duration::from_millis(450);

/// Grace period after the lease of a participant known from servers. If a server is there, it is to be the first to
/// report the participant gone, because it announces the participant again when it comes back.
pub(super) const SPARE: Duration = Duration::from_secs(5);

/// Time for the other side of a match to confirm it before the local endpoint is announced to the servers again, and
/// the longest pause between two such announcements.
const UNCONFIRMED: Duration = Duration::from_secs(1);
const MAX_UNCONFIRMED: Duration = Duration::from_secs(64);

/// Properties announced to servers.
const PROPERTIES: [(&str, &str); 2] = [("PARTICIPANT_TYPE", "SUPER_CLIENT"), ("DS_VERSION", "2.0")];

/// Announcements of a local endpoint whose match is not confirmed.
#[derive(Debug)]
pub(super) struct Repetition {
    /// Number of times that it was announced again.
    times: u32,
    /// Time of the next one.
    at: Instant,
}

/// Source of the discovery of another participant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum DiscoverySource {
    /// By its own announcement; contains the source address of the last one.
    Itself(IpAddr),
    /// As a configured server; contains the configured address.
    Named(SocketAddr),
    /// Through servers, which also report its disposal.
    Servers,
}

impl Engine {
    pub(super) fn is_client(&self) -> bool {
        !self.servers.is_empty()
    }

    /// Returns whether this is a known server.
    pub(super) fn is_server(&self, prefix: GuidPrefix) -> bool {
        let remote = self.remotes.get(&prefix);
        remote.is_some_and(|remote| matches!(remote.via, DiscoverySource::Named(_)))
    }

    /// Returns the configured servers on this machine.
    pub(super) fn local_servers(&self) -> impl Iterator<Item = SocketAddrV4> {
        self.servers.iter().filter_map(|server| match server.at {
            SocketAddr::V4(at) if self.network.is_local((*at.ip()).into()) => Some(at),
            _ => None,
        })
    }

    /// Returns the configured address of the server with this data. Its GUID prefix is derived from its position in the
    /// list, or it has another prefix (Fast DDS 3) and that address.
    fn find_server_address(&self, told: &ParticipantData) -> Option<SocketAddr> {
        let by_name = |server: &&DiscoveryServer| server.prefix() == told.prefix;
        let by_address = |server: &&DiscoveryServer| {
            let locators = || told.discovery.iter().filter_map(Locator::udp_address);
            let same = |at: SocketAddr| {
                let here = self.network.is_local(at.ip()) && self.network.is_local(server.at.ip());
                at.port() == server.at.port() && (here || at.ip() == server.at.ip())
            };
            locators().any(same)
        };
        let found = self.servers.iter().find(by_name);
        let found = found.or_else(|| self.servers.iter().find(by_address));
        found.map(|server| server.at)
    }

    // ---- sending to servers, and pinging participants known from them

    pub(super) fn add_server_endpoints(&mut self, now: Instant) {
        self.own.vendor = VendorId::FAST_DDS;
        self.add_builtin_pair(PARTICIPANTS);
        self.announce_self(now);
    }

    /// Returns the longest pause between two announcements.
    pub(super) fn longest_pause(&self) -> Duration {
        let is_met = |server: &DiscoveryServer| {
            let mut met = self.remotes.values();
            met.any(|remote| remote.via == DiscoverySource::Named(server.at))
        };
        if self.servers.iter().all(is_met) { LAST_PAUSE } else { MISSING }
    }

    /// Publishes changed data of this participant to the servers.
    pub(super) fn announce_self(&mut self, now: Instant) {
        let payload = self.own.to_bytes_with(&PROPERTIES);
        self.publish_announcement(now, EntityId::PARTICIPANT, payload);
    }

    /// Repeats the announcement to each server, in case it has restarted or was not there.
    pub(super) fn announce_to_servers(&mut self) {
        let Some(number) = self.announced.get(&EntityId::PARTICIPANT).copied() else {
            return;
        };
        let data = wire::Data {
            reader: EntityId::SPDP_READER,
            writer: EntityId::SPDP_WRITER,
            number,
            inline: InlineQos {
                related: self.announcement_identity(EntityId::SPDP_WRITER, number),
                status: 0,
                key_hash: None,
            },
            payload: Some(self.own.to_bytes_with(&PROPERTIES)),
            key_only: false,
        };
        for server in &self.servers {
            // Addressed to any participant, because a restarted server may have another GUID prefix.
            let mut writer = wire::DatagramWriter::new(self.own.prefix);
            writer.timestamp(SystemTime::now().into());
            writer.data(&data);
            self.control.push_back(Datagram::from_writer(server.at, writer));
        }
    }

    pub(super) fn leave_servers(&mut self, now: Instant) {
        let own = self.guid();
        let change = CacheChange {
            status: DISPOSED,
            key: Some(own.bytes()),
            ..Engine::announcement_change(discovery::key_payload(own))
        };
        self.publish(now, EntityId::SPDP_WRITER, change);
    }

    /// Returns the identity of an announcement; servers do not forward announcements without one.
    pub(super) fn announcement_identity(&self, announcer: EntityId, number: SequenceNumber) -> Option<SampleIdentity> {
        let writer = Guid::new(self.own.prefix, announcer);
        (self.is_client() && announcer.is_builtin()).then_some(SampleIdentity { writer, number })
    }

    /// Pings participants known from servers, which send us no announcements, so that they are eventually removed even
    /// without a server: they may have ended together with it.
    pub(super) fn ping_silent(&mut self, now: Instant) {
        let silent = self.remotes.iter().filter(|(_, remote)| {
            remote.via == DiscoverySource::Servers && now.saturating_duration_since(remote.heard) >= LAST_PAUSE
        });
        let silent: Vec<GuidPrefix> = silent.map(|(prefix, _)| *prefix).collect();
        for prefix in silent {
            let mut wanted = SendRequests::default();
            let mut writers = self.writers.iter();
            let asked = writers.find(|(_, writer)| writer.state.request_ack(prefix, &mut wanted));
            let Some(entity) = asked.map(|(entity, _)| *entity) else {
                continue;
            };
            self.enqueue(entity, wanted);
            if let Some(remote) = self.remotes.get_mut(&prefix) {
                remote.asked.get_or_insert(now);
            }
        }
    }

    /// Announces local endpoints to the servers again while a participant known from them does not confirm a match: a
    /// server of Fast DDS 2.14 loses an announcement that it handles together with the disposal of another endpoint
    /// (seen on the wire: acknowledged, and forwarded to nobody), and forwards a new one.
    pub(super) fn repeat_unconfirmed(&mut self, now: Instant) {
        if !self.is_client() {
            return;
        }
        let remotes = &self.remotes;
        let is_unconfirmed = |(end, confirmed): (&Arc<EndpointData>, bool)| {
            let remote = remotes.get(&end.guid.prefix);
            !confirmed && remote.is_some_and(|remote| remote.via == DiscoverySource::Servers)
        };
        let writers = self.writers.iter().map(|(entity, it)| (*entity, it.state.readers().any(is_unconfirmed)));
        let readers = self.readers.iter().map(|(entity, it)| (*entity, it.state.writers().any(is_unconfirmed)));
        let unconfirmed: BTreeSet<EntityId> =
            writers.chain(readers).filter_map(|(entity, any)| any.then_some(entity)).collect();
        self.repetitions.retain(|entity, _| unconfirmed.contains(entity));
        for entity in unconfirmed {
            let first = Repetition { times: 0, at: now + UNCONFIRMED };
            let repetition = self.repetitions.entry(entity).or_insert(first);
            if repetition.at > now {
                continue;
            }
            repetition.times += 1;
            let pause = UNCONFIRMED * 2_u32.saturating_pow(repetition.times.min(8));
            repetition.at = now + pause.min(MAX_UNCONFIRMED);
            let times = repetition.times;
            let writer = self.writers.get(&entity).map(|it| &it.state.own);
            let own = writer.or_else(|| self.readers.get(&entity).map(|it| &it.state.own));
            if let Some(again) = own.map(|own| own.to_bytes_again(times)) {
                self.publish_announcement(now, entity, again);
            }
        }
    }

    // ---- receiving from servers

    /// Handles an announcement of a participant. A configured server is matched; everything else from a known server
    /// arrives in order through [`Self::on_server_data`], and other participants are ignored.
    pub(super) fn on_server_announcement(&mut self, now: Instant, from: GuidPrefix, source: IpAddr, data: &wire::Data) {
        if data.inline.status != 0 {
            // The last message of a server is sent only once.
            let gone = discovery::guid_of_key(data);
            if self.is_server(from) && gone.is_some_and(|gone| gone.prefix == from) {
                self.remove_participant(from);
            }
            return;
        }
        if self.is_server(from) {
            return;
        }
        let told = data.payload.as_ref().map(ParticipantData::from_payload);
        let Some(Ok(told)) = told.filter(|_| from != self.own.prefix) else {
            return;
        };
        if told.prefix != from {
            return;
        }
        match self.find_server_address(&told) {
            Some(address) => self.add_participant(now, DiscoverySource::Named(address), told),
            None => tracing::debug!(
                %source,
                "a DDS participant that is not one of the discovery servers is ignored"
            ),
        }
    }

    /// Matches a server: everything is sent to it and requested from it.
    pub(super) fn match_server(&mut self, now: Instant, prefix: GuidPrefix) {
        for pair in [PARTICIPANTS].into_iter().chain(ANNOUNCERS) {
            self.match_builtin(now, prefix, pair, true, true);
        }
        self.wake(now);
    }

    /// Handles the announcement or disposal of a participant by a server.
    pub(super) fn on_server_data(&mut self, now: Instant, sample: &ReceivedSample) {
        if let Some(gone) = sample.withdrawn {
            self.remove_participant(gone.prefix);
            return;
        }
        let told = match ParticipantData::from_payload(&sample.payload) {
            Ok(told) => told,
            Err(error) => {
                tracing::debug!(%error, "a participant announced by a discovery server was not understood");
                return;
            }
        };
        let server = sample.writer.prefix;
        let via = match self.remotes.get(&server).map(|server| server.via) {
            Some(via @ DiscoverySource::Named(_)) if told.prefix == server => via,
            // Other servers announce themselves.
            Some(DiscoverySource::Named(_)) if self.find_server_address(&told).is_none() => DiscoverySource::Servers,
            _ => return,
        };
        if told.prefix != self.own.prefix {
            self.update_participant(now, via, told);
        }
    }

    /// Handles an acknowledgement of one of our built-in writers by a server. A server that has lost what it had
    /// acknowledged has restarted.
    pub(super) fn on_server_acknack(&mut self, now: Instant, reader: Guid, writer: EntityId, set: &SequenceSet) {
        let Some(ours) = self.writers.get(&writer).filter(|_| writer.is_builtin()) else {
            return;
        };
        let lost = ours.state.last_acknowledged(reader).is_some_and(|had| set.base <= had);
        if lost && self.is_server(reader.prefix) {
            tracing::debug!(server = ?reader.prefix, "a discovery server was restarted");
            self.match_server(now, reader.prefix);
        }
    }
}
