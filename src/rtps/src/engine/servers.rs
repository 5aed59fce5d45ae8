//! Servers of discovery of Fast DDS: their clients tell them alone of themselves, and hear of each other by them.
//!
//! ```text
//!   no server is met ─▶ our announcement, again and again ─▶ it announces itself ─▶ met
//!   met ─▶ our announcement and our ends, reliably; each bears its identity, by which it is known behind other servers
//!       ◀─ those of all others, reliably, who are sent samples and nothing else
//! ```
//! No standard has this. What is said here is what Fast DDS 2.14 says, as seen on the wire and in its sources (`PDPClient`, `PDPServer`,
//! `DiscoveryDataBase`):
//! - Participants are announced by the same ends as without servers, which are reliable between a server and its clients.
//! - A server hears those alone that say that they are of Fast DDS (`PID_VENDOR_ID`); so does ours.
//! - `PARTICIPANT_TYPE` says what a participant is. A `SUPER_CLIENT` is told of everybody, a `CLIENT` of whom it has a topic in
//!   common with.
//! - A server that was begun anew has the same name. It is known by that it has lost what it had acknowledged.

#![forbid(unsafe_code)]

#[cfg(test)]
mod tests;

use std::net::{IpAddr, SocketAddr, SocketAddrV4};
use std::time::{Duration, Instant, SystemTime};

use super::discovering::{ANNOUNCERS, DISPOSED, LAST_PAUSE, PARTICIPANTS};
use super::{Datagram, Engine};
use crate::discovery::{self, ParticipantData};
use crate::locator::Locator;
use crate::participant::{DiscoveryServer, Sample};
use crate::sequence::SequenceSet;
use crate::wire::{self, InlineQos};
use crate::writer::{Change, Wanted};
use crate::{EntityId, Guid, GuidPrefix, SampleIdentity, SequenceNumber, VendorId};

/// A server that is not there is told of us so often.
const MISSING: Duration = Duration::from_millis(450);

/// So much longer than its lease may nothing be heard of whoever servers tell of: should a server be there, it is to be the first
/// to say that it is gone, as it tells of it again when it comes back.
pub(super) const SPARE: Duration = Duration::from_secs(5);

/// What we are to servers.
const PROPERTIES: [(&str, &str); 2] = [("PARTICIPANT_TYPE", "SUPER_CLIENT"), ("DS_VERSION", "2.0")];

/// By whom another participant is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Via {
    /// It announces itself; the address from which it was heard last.
    Itself(IpAddr),
    /// It is one of the servers that were named; the address by which.
    Named(SocketAddr),
    /// Servers tell of it, and take it back.
    Servers,
}

impl Engine {
    pub(super) fn is_client(&self) -> bool {
        !self.servers.is_empty()
    }

    /// Whether this is a server of ours that was met.
    pub(super) fn is_server(&self, prefix: GuidPrefix) -> bool {
        let remote = self.remotes.get(&prefix);
        remote.is_some_and(|remote| matches!(remote.via, Via::Named(_)))
    }

    /// Servers on this machine, where they were named.
    pub(super) fn servers_here(&self) -> impl Iterator<Item = SocketAddrV4> {
        self.servers.iter().filter_map(|server| match server.at {
            SocketAddr::V4(at) if self.network.is_here((*at.ip()).into()) => Some(at),
            _ => None,
        })
    }

    /// The address by which the server was named that tells this of itself. It has the name of its place in the list, or one of
    /// its own (Fast DDS 3) and that address.
    fn named(&self, told: &ParticipantData) -> Option<SocketAddr> {
        let by_name = |server: &&DiscoveryServer| server.prefix() == told.prefix;
        let by_address = |server: &&DiscoveryServer| {
            let locators = || told.discovery.iter().filter_map(Locator::udp);
            let same = |at: SocketAddr| {
                let here = self.network.is_here(at.ip()) && self.network.is_here(server.at.ip());
                at.port() == server.at.port() && (here || at.ip() == server.at.ip())
            };
            locators().any(same)
        };
        let found = self.servers.iter().find(by_name);
        let found = found.or_else(|| self.servers.iter().find(by_address));
        found.map(|server| server.at)
    }

    // ---- telling them, and asking those of whom they tell

    pub(super) fn add_ends_for_servers(&mut self, now: Instant) {
        self.own.vendor = VendorId::FAST_DDS;
        self.add_builtin_pair(PARTICIPANTS);
        self.announce_self(now);
    }

    /// The longest pause between two announcements.
    pub(super) fn longest_pause(&self) -> Duration {
        let is_met = |server: &DiscoveryServer| {
            let mut met = self.remotes.values();
            met.any(|remote| remote.via == Via::Named(server.at))
        };
        match self.servers.iter().all(is_met) {
            true => LAST_PAUSE,
            false => MISSING,
        }
    }

    /// What this participant tells servers of itself has changed.
    pub(super) fn announce_self(&mut self, now: Instant) {
        let payload = self.own.to_bytes_with(&PROPERTIES);
        self.announce_as(now, EntityId::PARTICIPANT, payload);
    }

    /// Says to each server what it was told before, should it have forgotten or not been there.
    pub(super) fn announce_to_servers(&mut self) {
        let Some(number) = self.announced.get(&EntityId::PARTICIPANT).copied() else {
            return;
        };
        let data = wire::Data {
            reader: EntityId::SPDP_READER,
            writer: EntityId::SPDP_WRITER,
            number,
            inline: InlineQos {
                related: self.identity(EntityId::SPDP_WRITER, number),
                status: 0,
                key_hash: None,
            },
            payload: Some(self.own.to_bytes_with(&PROPERTIES)),
            key_only: false,
        };
        for server in &self.servers {
            // To whoever is there: a server begun anew may have another name.
            let mut writer = wire::DatagramWriter::new(self.own.prefix);
            writer.timestamp(SystemTime::now().into());
            writer.data(&data);
            self.control.push_back(Datagram::whole(server.at, writer));
        }
    }

    pub(super) fn leave_servers(&mut self, now: Instant) {
        let own = self.guid();
        let change = Change {
            status: DISPOSED,
            key: Some(own.bytes()),
            ..Engine::change_of_announcement(discovery::key(own))
        };
        self.publish(now, EntityId::SPDP_WRITER, change);
    }

    /// By what an announcement of ours is known behind other servers: a server passes nothing on that has no identity.
    pub(super) fn identity(
        &self,
        announcer: EntityId,
        number: SequenceNumber,
    ) -> Option<SampleIdentity> {
        let writer = Guid::new(self.own.prefix, announcer);
        (self.is_client() && announcer.is_builtin()).then_some(SampleIdentity { writer, number })
    }

    /// Whoever servers tell of says nothing to us of itself. So it is asked, for that it be gone some day also where no server says
    /// so: it may have ended together with the server.
    pub(super) fn ask_silent(&mut self, now: Instant) {
        let silent = self.remotes.iter().filter(|(_, remote)| {
            remote.via == Via::Servers && now.saturating_duration_since(remote.heard) >= LAST_PAUSE
        });
        let silent: Vec<GuidPrefix> = silent.map(|(prefix, _)| *prefix).collect();
        for prefix in silent {
            let mut wanted = Wanted::default();
            let mut writers = self.writers.iter();
            let asked = writers.find(|(_, writer)| writer.state.ask(prefix, &mut wanted));
            let Some(entity) = asked.map(|(entity, _)| *entity) else {
                continue;
            };
            self.enqueue(entity, wanted);
            if let Some(remote) = self.remotes.get_mut(&prefix) {
                remote.asked.get_or_insert(now);
            }
        }
    }

    // ---- hearing them

    /// A participant announces itself, or others where it is a server. One that is named is met; all else of a server that is met
    /// comes in order, by [`Self::server_tells`], and of whoever is none nothing is heard.
    pub(super) fn server_heard(
        &mut self,
        now: Instant,
        from: GuidPrefix,
        source: IpAddr,
        data: &wire::Data,
    ) {
        if data.inline.status != 0 {
            // What a server says last, it says once.
            let gone = discovery::guid_of_key(data);
            if self.is_server(from) && gone.is_some_and(|gone| gone.prefix == from) {
                self.participant_gone(from);
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
        match self.named(&told) {
            Some(address) => self.participant_came(now, Via::Named(address), told),
            None => tracing::debug!(
                %source,
                "a DDS participant that is none of the discovery servers announces itself and is not heard"
            ),
        }
    }

    /// A server is there: it is told all, and asked for all.
    pub(super) fn meet_server(&mut self, now: Instant, prefix: GuidPrefix) {
        for pair in [PARTICIPANTS].into_iter().chain(ANNOUNCERS) {
            self.match_builtin(now, prefix, pair, true, true);
        }
        self.wake(now);
    }

    /// A server tells of a participant, or that one is gone.
    pub(super) fn server_tells(&mut self, now: Instant, sample: &Sample) {
        if let Some(gone) = sample.withdrawn {
            self.participant_gone(gone.prefix);
            return;
        }
        let told = match ParticipantData::from_payload(&sample.payload) {
            Ok(told) => told,
            Err(error) => {
                tracing::debug!(%error, "what a discovery server tells of a participant was not understood");
                return;
            }
        };
        let server = sample.writer.prefix;
        let via = match self.remotes.get(&server).map(|server| server.via) {
            Some(via @ Via::Named(_)) if told.prefix == server => via,
            // Other servers are met by themselves.
            Some(Via::Named(_)) if self.named(&told).is_none() => Via::Servers,
            _ => return,
        };
        if told.prefix != self.own.prefix {
            self.participant_told(now, via, told);
        }
    }

    /// A reader of a server says what it has of what one of our own writers has announced. One that has lost what it had is a
    /// server's that was begun anew.
    pub(super) fn server_acknowledges(
        &mut self,
        now: Instant,
        reader: Guid,
        writer: EntityId,
        set: &SequenceSet,
    ) {
        let Some(ours) = self.writers.get(&writer).filter(|_| writer.is_builtin()) else {
            return;
        };
        let lost = ours
            .state
            .acknowledged(reader)
            .is_some_and(|had| set.base <= had);
        if lost && self.is_server(reader.prefix) {
            tracing::debug!(server = ?reader.prefix, "a discovery server was begun anew");
            self.meet_server(now, reader.prefix);
        }
    }
}
