//! Ports of this machine: a newcomer's is seen when it is bound, and whoever is killed is gone when its port is free.

use std::collections::BTreeSet;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::time::Instant;

use super::servers::Via;
use super::{Engine, Remote};
use crate::GuidPrefix;

/// So many of the lowest free numbers of participants are looked at.
const NUMBERS_AHEAD: usize = 6;

impl Engine {
    /// Where participants of this machine may hear of others: those of whom we know, and those that newcomers take first.
    pub fn ports_to_look_at(&self) -> BTreeSet<SocketAddrV4> {
        if self.alone {
            return BTreeSet::new();
        }
        let known: BTreeSet<SocketAddrV4> = self
            .remotes
            .values()
            .filter_map(|remote| self.here(remote))
            .chain(self.bound.iter().copied())
            .collect();
        let taken = |port: u16| known.iter().any(|at| at.port() == port);
        // Participants take the lowest number whose ports are free. A client's concern are its servers.
        let numbers = if self.is_client() { 0..0 } else { 0..u16::MAX };
        let free = numbers
            .map_while(|number| self.ports.discovery(number))
            .filter(|port| !taken(*port))
            .take(NUMBERS_AHEAD)
            .map(|port| SocketAddrV4::new(Ipv4Addr::LOCALHOST, port));
        let own = self.own_ports().0;
        let servers = self.servers_here();
        let mut ports: BTreeSet<SocketAddrV4> =
            free.chain(known.iter().copied()).chain(servers).collect();
        ports.retain(|at| at.port() != own);
        ports
    }

    /// Which of [`Self::ports_to_look_at`] are bound: newcomers are told of us at once, and whose port is gone is dead.
    pub fn ports_bound(&mut self, now: Instant, bound: &BTreeSet<SocketAddrV4>) {
        let last = self.ports.discovery(119).unwrap_or(u16::MAX);
        let domain = self.ports.discovery_multicast()..=last;
        let servers: BTreeSet<SocketAddrV4> = self.servers_here().collect();
        let concerns = |at: &&SocketAddrV4| match self.is_client() {
            true => servers.contains(at),
            false => domain.contains(&at.port()),
        };
        let found: BTreeSet<SocketAddrV4> = bound.iter().filter(concerns).copied().collect();
        let new: Vec<SocketAddrV4> = found.difference(&self.bound).copied().collect();
        if !new.is_empty() {
            if !self.is_client() {
                for at in new {
                    self.announce_to(SocketAddr::V4(at), GuidPrefix::UNKNOWN);
                }
            }
            self.announce_soon(now);
        }
        self.bound = found;
        let dead: Vec<GuidPrefix> = self
            .remotes
            .iter()
            .filter(|(_, remote)| self.here(remote).is_some_and(|at| !bound.contains(&at)))
            .map(|(prefix, _)| *prefix)
            .collect();
        for prefix in dead {
            self.participant_gone(prefix);
        }
        self.tell();
    }

    /// Where a participant of this machine hears of others.
    fn here(&self, remote: &Remote) -> Option<SocketAddrV4> {
        match remote.discovery {
            // It may be reached through another's port.
            _ if matches!(remote.via, Via::Named(_)) => None,
            SocketAddr::V4(at) if self.network.is_here((*at.ip()).into()) => Some(at),
            _ => None,
        }
    }
}
