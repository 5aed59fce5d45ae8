//! Detection of participants by the ports bound on this machine: a new port is a newcomer, and a participant whose port
//! is free has died.

use std::collections::BTreeSet;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::time::Instant;

use super::servers::DiscoverySource;
use super::{Engine, RemoteParticipant};
use crate::GuidPrefix;

/// Number of lowest free participant numbers whose ports are watched.
const NUMBERS_AHEAD: usize = 6;

impl Engine {
    /// Returns the discovery ports to watch on this machine: those of known participants, and those that newcomers will
    /// use first.
    pub fn watched_ports(&self) -> BTreeSet<SocketAddrV4> {
        if self.alone {
            return BTreeSet::new();
        }
        let known: BTreeSet<SocketAddrV4> = self
            .remotes
            .values()
            .filter_map(|remote| self.local_address(remote))
            .chain(self.bound.iter().copied())
            .collect();
        let taken = |port: u16| known.iter().any(|at| at.port() == port);
        // Participants use the lowest number whose ports are free. A client watches only its servers.
        let numbers = if self.is_client() { 0..0 } else { 0..u16::MAX };
        let free = numbers
            .map_while(|number| self.ports.discovery(number))
            .filter(|port| !taken(*port))
            .take(NUMBERS_AHEAD)
            .map(|port| SocketAddrV4::new(Ipv4Addr::LOCALHOST, port));
        let own = self.own_ports().0;
        let servers = self.local_servers();
        let mut ports: BTreeSet<SocketAddrV4> = free.chain(known.iter().copied()).chain(servers).collect();
        ports.retain(|at| at.port() != own);
        ports
    }

    /// Sets which of [`Self::watched_ports`] are bound. Newcomers are sent an announcement immediately; participants
    /// whose port is gone are removed.
    pub fn set_bound_ports(&mut self, now: Instant, bound: &BTreeSet<SocketAddrV4>) {
        let last = self.ports.discovery(119).unwrap_or(u16::MAX);
        let domain = self.ports.discovery_multicast()..=last;
        let servers: BTreeSet<SocketAddrV4> = self.local_servers().collect();
        let concerns = |at: &&SocketAddrV4| {
            if self.is_client() { servers.contains(at) } else { domain.contains(&at.port()) }
        };
        let found: BTreeSet<SocketAddrV4> = bound.iter().filter(concerns).copied().collect();
        let new: Vec<SocketAddrV4> = found.difference(&self.bound).copied().collect();
        if !new.is_empty() {
            if !self.is_client() {
                for at in new {
                    self.send_announcement(SocketAddr::V4(at), GuidPrefix::UNKNOWN);
                }
            }
            self.announce_soon(now);
        }
        self.bound = found;
        let dead: Vec<GuidPrefix> = self
            .remotes
            .iter()
            .filter(|(_, remote)| self.local_address(remote).is_some_and(|at| !bound.contains(&at)))
            .map(|(prefix, _)| *prefix)
            .collect();
        for prefix in dead {
            self.remove_participant(prefix);
        }
        self.publish_changes();
    }

    /// Returns the discovery address of a participant on this machine.
    fn local_address(&self, remote: &RemoteParticipant) -> Option<SocketAddrV4> {
        match remote.discovery {
            // It may be reached through a forwarded port.
            _ if matches!(remote.via, DiscoverySource::Named(_)) => None,
            SocketAddr::V4(at) if self.network.is_local((*at.ip()).into()) => Some(at),
            _ => None,
        }
    }
}
