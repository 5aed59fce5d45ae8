//! Other participants: they come, say something else of themselves, and are gone.

#![forbid(unsafe_code)]

#[cfg(test)]
mod tests;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Instant;

use super::discovering::{ANNOUNCERS, ANNOUNCES, HEARS, MOST_PARTICIPANTS, PARTICIPANTS, builtin};
use super::servers::Via;
use super::{Engine, Remote};
use crate::discovery::{EndpointData, ParticipantData};
use crate::locator::Locator;
use crate::participant::Discovered;
use crate::writer::Wanted;
use crate::{EntityId, Guid, GuidPrefix};

impl Engine {
    /// This is what is told of a participant: a new one, or one that is known.
    pub(super) fn participant_told(&mut self, now: Instant, via: Via, told: ParticipantData) {
        let prefix = told.prefix;
        let Some(remote) = self.remotes.get_mut(&prefix) else {
            self.participant_came(now, via, told);
            return;
        };
        if *remote.data == told {
            return;
        }
        // What it has may have changed, or where it is: then it is met anew, unless it is still there where it was.
        let left = |told: &[Locator], at: SocketAddr| {
            !told.iter().filter_map(Locator::udp).any(|it| it == at)
        };
        let moved = left(&told.discovery, remote.discovery) && !matches!(via, Via::Named(_))
            || remote.data.user != told.user && left(&told.user, remote.user)
            || remote.data.builtin != told.builtin;
        if moved {
            self.participant_met_anew(now, via, told);
            return;
        }
        remote.data = Arc::new(told);
        self.discovered
            .participants
            .insert(prefix, Arc::clone(&remote.data));
        self.discovered_changed = true;
    }

    /// A participant that is known is to be reached in another way.
    pub(super) fn participant_met_anew(&mut self, now: Instant, via: Via, told: ParticipantData) {
        // Its ends are told by itself when it is met, but not by a server, who has told them.
        let ends = match via {
            Via::Servers => self.ends_of(told.prefix),
            Via::Itself(_) | Via::Named(_) => Vec::new(),
        };
        self.participant_gone(told.prefix);
        self.participant_came(now, via, told);
        for end in ends {
            self.end_came(now, end);
        }
    }

    fn ends_of(&self, prefix: GuidPrefix) -> Vec<Arc<EndpointData>> {
        let Discovered {
            writers, readers, ..
        } = &self.discovered;
        let all = writers.values().chain(readers.values());
        all.filter(|end| end.guid.prefix == prefix)
            .cloned()
            .collect()
    }

    pub(super) fn participant_came(&mut self, now: Instant, via: Via, told: ParticipantData) {
        let chosen = match via {
            Via::Named(address) => Some(address),
            Via::Itself(source) => self.network.choose(&told.discovery, Some(source)),
            Via::Servers => self.network.choose(&told.discovery, None),
        };
        let Some(discovery) = chosen else {
            tracing::debug!(
                ?via,
                "a DDS participant tells no address of UDP over IPv4 that leads to it"
            );
            return;
        };
        // An address belongs to one process at a time: whoever had it before is gone. Servers tell also of the dead for a while,
        // and not in the order in which they came.
        let other = |remote: &Remote| match via {
            Via::Itself(_) => remote.discovery == discovery,
            Via::Named(_) => remote.via == via,
            Via::Servers => false,
        };
        let before: Vec<GuidPrefix> = self
            .remotes
            .iter()
            .filter(|(_, remote)| other(remote))
            .map(|(prefix, _)| *prefix)
            .collect();
        for prefix in before {
            self.participant_gone(prefix);
        }
        if self.remotes.len() >= MOST_PARTICIPANTS {
            if !std::mem::replace(&mut self.crowded, true) {
                tracing::warn!(
                    "more than {MOST_PARTICIPANTS} DDS participants; {:?} is not heard, nor are others",
                    told.prefix
                );
            }
            return;
        }
        let user = self
            .network
            .choose(&told.user, Some(discovery.ip()))
            .unwrap_or(discovery);
        let (prefix, has) = (told.prefix, told.builtin);
        let data = Arc::new(told);
        self.discovered
            .participants
            .insert(prefix, Arc::clone(&data));
        self.discovered_changed = true;
        self.remotes.insert(
            prefix,
            Remote {
                data,
                discovery,
                user,
                via,
                heard: now,
                asked: None,
            },
        );
        match via {
            // It speaks of ends with its servers alone.
            Via::Servers => {}
            Via::Named(_) => self.meet_server(now, prefix),
            Via::Itself(_) => {
                self.announce_to(discovery, prefix);
                for (index, pair) in ANNOUNCERS.into_iter().enumerate() {
                    let (hears, announces) = (has & HEARS[index] != 0, has & ANNOUNCES[index] != 0);
                    self.match_builtin(now, prefix, pair, hears, announces);
                }
                self.announce_soon(now);
            }
        }
        self.wake(now);
    }

    /// A pair of ours meets that of another participant, which hears or announces, or both.
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
        let mut wanted = Wanted::default();
        if let Some(ours) = self.writers.get_mut(&writer).filter(|_| hears) {
            let theirs = Arc::new(builtin(prefix, reader));
            ours.state.matched(now, theirs, discovery, &mut wanted);
        }
        self.enqueue(writer, wanted);
        if let Some(ours) = self.readers.get_mut(&reader).filter(|_| announces) {
            let theirs = Arc::new(builtin(prefix, writer));
            ours.state.matched(now, theirs, discovery, vendor);
        }
    }

    /// A participant has gone, and with it all its ends.
    pub fn participant_gone(&mut self, prefix: GuidPrefix) {
        let Some(remote) = self.remotes.remove(&prefix) else {
            return;
        };
        self.discovered.participants.remove(&prefix);
        self.discovered_changed = true;
        for (writer, reader) in ANNOUNCERS.into_iter().chain([PARTICIPANTS]) {
            if let Some(ours) = self.writers.get_mut(&writer) {
                ours.state.unmatched(Guid::new(prefix, reader));
            }
            if let Some(ours) = self.readers.get_mut(&reader) {
                ours.state.unmatched(Guid::new(prefix, writer));
            }
        }
        let ends = self
            .discovered
            .writers
            .keys()
            .chain(self.discovered.readers.keys());
        let ends: Vec<Guid> = ends.filter(|guid| guid.prefix == prefix).copied().collect();
        for guid in ends {
            self.end_gone(guid);
        }
        let still = |address: SocketAddr| {
            self.remotes
                .values()
                .any(|other| other.discovery == address || other.user == address)
        };
        let unused: Vec<SocketAddr> = [remote.discovery, remote.user]
            .into_iter()
            .filter(|address| !still(*address))
            .collect();
        for address in unused {
            self.paths.remove(&address);
        }
    }
}
