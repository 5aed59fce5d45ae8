//! Remote participants: discovery, changes and removal.

#![forbid(unsafe_code)]

#[cfg(test)]
mod tests;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Instant;

use super::discovering::{ANNOUNCERS, ANNOUNCES, HEARS, MOST_PARTICIPANTS, PARTICIPANTS, builtin_endpoint};
use super::servers::DiscoverySource;
use super::{Engine, RemoteParticipant};
use crate::discovery::{EndpointData, ParticipantData};
use crate::locator::Locator;
use crate::shared::DiscoveredGraph;
use crate::writer::SendRequests;
use crate::{EntityId, Guid, GuidPrefix};

impl Engine {
    /// Handles the announcement of a new or known participant.
    pub(super) fn update_participant(&mut self, now: Instant, via: DiscoverySource, told: ParticipantData) {
        let prefix = told.prefix;
        let Some(remote) = self.remotes.get_mut(&prefix) else {
            self.add_participant(now, via, told);
            return;
        };
        if *remote.data == told {
            return;
        }
        // If its endpoints or address may have changed, it is discovered anew, unless it is still at the same address.
        let left = |told: &[Locator], at: SocketAddr| !told.iter().filter_map(Locator::udp_address).any(|it| it == at);
        let moved = left(&told.discovery, remote.discovery) && !matches!(via, DiscoverySource::Named(_))
            || remote.data.user != told.user && left(&told.user, remote.user)
            || remote.data.builtin != told.builtin;
        if moved {
            self.rematch_participant(now, via, told);
            return;
        }
        remote.data = Arc::new(told);
        self.discovered.participants.insert(prefix, Arc::clone(&remote.data));
        self.discovered_changed = true;
    }

    /// Rediscovers a known participant at another address.
    pub(super) fn rematch_participant(&mut self, now: Instant, via: DiscoverySource, told: ParticipantData) {
        // A participant announces its endpoints when it is discovered again, but a server does not repeat them.
        let ends = match via {
            DiscoverySource::Servers => self.endpoints_of(told.prefix),
            DiscoverySource::Itself(_) | DiscoverySource::Named(_) => Vec::new(),
        };
        self.remove_participant(told.prefix);
        self.add_participant(now, via, told);
        for end in ends {
            self.on_endpoint_discovered(now, end);
        }
    }

    fn endpoints_of(&self, prefix: GuidPrefix) -> Vec<Arc<EndpointData>> {
        let DiscoveredGraph { writers, readers, .. } = &self.discovered;
        let all = writers.values().chain(readers.values());
        all.filter(|end| end.guid.prefix == prefix).cloned().collect()
    }

    pub(super) fn add_participant(&mut self, now: Instant, via: DiscoverySource, told: ParticipantData) {
        let chosen = match via {
            DiscoverySource::Named(address) => Some(address),
            DiscoverySource::Itself(source) => self.network.choose_address(&told.discovery, Some(source)),
            DiscoverySource::Servers => self.network.choose_address(&told.discovery, None),
        };
        let Some(discovery) = chosen else {
            tracing::debug!(?via, "a DDS participant announces no address for UDP over IPv4 that reaches it");
            return;
        };
        // An address belongs to one process at a time, so its previous owner is gone. Servers also announce
        // participants that have died, and in any order.
        let other = |remote: &RemoteParticipant| match via {
            DiscoverySource::Itself(_) => remote.discovery == discovery,
            DiscoverySource::Named(_) => remote.via == via,
            DiscoverySource::Servers => false,
        };
        let before: Vec<GuidPrefix> =
            self.remotes.iter().filter(|(_, remote)| other(remote)).map(|(prefix, _)| *prefix).collect();
        for prefix in before {
            self.remove_participant(prefix);
        }
        if self.remotes.len() >= MOST_PARTICIPANTS {
            if !std::mem::replace(&mut self.crowded, true) {
                tracing::warn!(
                    "more than {MOST_PARTICIPANTS} DDS participants; {:?} and further ones are ignored",
                    told.prefix
                );
            }
            return;
        }
        let user = self.network.choose_address(&told.user, Some(discovery.ip())).unwrap_or(discovery);
        let (prefix, has) = (told.prefix, told.builtin);
        let data = Arc::new(told);
        self.discovered.participants.insert(prefix, Arc::clone(&data));
        self.discovered_changed = true;
        self.remotes.insert(prefix, RemoteParticipant { data, discovery, user, via, heard: now, asked: None });
        match via {
            // It exchanges endpoint data only with its servers.
            DiscoverySource::Servers => {}
            DiscoverySource::Named(_) => self.match_server(now, prefix),
            DiscoverySource::Itself(_) => {
                self.send_announcement(discovery, prefix);
                for (index, pair) in ANNOUNCERS.into_iter().enumerate() {
                    let (hears, announces) = (has & HEARS[index] != 0, has & ANNOUNCES[index] != 0);
                    self.match_builtin(now, prefix, pair, hears, announces);
                }
                self.announce_soon(now);
            }
        }
        self.wake(now);
    }

    /// Matches a built-in writer and reader with those of another participant, as far as it has them.
    pub(super) fn match_builtin(
        &mut self,
        now: Instant,
        prefix: GuidPrefix,
        (writer, reader): (EntityId, EntityId),
        hears: bool,
        announces: bool,
    ) {
        let Some(remote) = self.remotes.get(&prefix) else {
            return;
        };
        let (discovery, vendor) = (remote.discovery, remote.data.vendor);
        let mut wanted = SendRequests::default();
        if let Some(ours) = self.writers.get_mut(&writer).filter(|_| hears) {
            let theirs = Arc::new(builtin_endpoint(prefix, reader));
            ours.state.add_reader(now, theirs, discovery, &mut wanted);
        }
        self.enqueue(writer, wanted);
        if let Some(ours) = self.readers.get_mut(&reader).filter(|_| announces) {
            let theirs = Arc::new(builtin_endpoint(prefix, writer));
            ours.state.add_writer(now, theirs, discovery, vendor);
        }
    }

    /// Removes a participant and all its endpoints.
    pub fn remove_participant(&mut self, prefix: GuidPrefix) {
        let Some(remote) = self.remotes.remove(&prefix) else {
            return;
        };
        self.discovered.participants.remove(&prefix);
        self.discovered_changed = true;
        for (writer, reader) in ANNOUNCERS.into_iter().chain([PARTICIPANTS]) {
            if let Some(ours) = self.writers.get_mut(&writer) {
                ours.state.remove_reader(Guid::new(prefix, reader));
            }
            if let Some(ours) = self.readers.get_mut(&reader) {
                ours.state.remove_writer(Guid::new(prefix, writer));
            }
        }
        let ends = self.discovered.writers.keys().chain(self.discovered.readers.keys());
        let ends: Vec<Guid> = ends.filter(|guid| guid.prefix == prefix).copied().collect();
        for guid in ends {
            self.on_endpoint_lost(guid);
        }
        let still = |address: SocketAddr| {
            self.remotes.values().any(|other| other.discovery == address || other.user == address)
        };
        let unused: Vec<SocketAddr> =
            [remote.discovery, remote.user].into_iter().filter(|address| !still(*address)).collect();
        for address in unused {
            self.paths.remove(&address);
        }
    }
}
