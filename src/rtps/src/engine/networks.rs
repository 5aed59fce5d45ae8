//! Changes of this machine's network interfaces at run time.

use std::time::Instant;

use super::Engine;
use super::servers::DiscoverySource;
use crate::GuidPrefix;
use crate::locator::Locator;
use crate::network::InterfaceSet;

impl Engine {
    /// Returns the ports for discovery data and for samples of this participant.
    pub(super) fn own_ports(&self) -> (u16, u16) {
        let port = |locators: &[Locator]| {
            let first = locators.first();
            first.map_or(0, |locator| u16::try_from(locator.port).unwrap_or(0))
        };
        (port(&self.own.discovery), port(&self.own.user))
    }

    /// Sets the current interfaces of this machine. Our new locators are announced, and participants whose network is
    /// gone are reached at another address, if they have one.
    pub fn set_network(&mut self, now: Instant, network: InterfaceSet) {
        if network == self.network {
            return;
        }
        let (discovery, user) = self.own_ports();
        self.network = network;
        let (discovery, user) = (self.network.locators(discovery), self.network.locators(user));
        if (&discovery, &user) != (&self.own.discovery, &self.own.user) {
            self.own.discovery = discovery;
            self.own.user = user;
            if self.is_client() {
                self.announce_self(now);
            }
            self.reannounce_endpoints(now);
        }
        let moved: Vec<GuidPrefix> = self
            .remotes
            .iter()
            .filter(|(_, remote)| {
                let leads = self.network.is_reachable(remote.discovery.ip());
                let told = &remote.data.discovery;
                let chosen = || match remote.via {
                    DiscoverySource::Itself(source) => self.network.choose_address(told, Some(source)),
                    DiscoverySource::Servers => self.network.choose_address(told, None),
                    DiscoverySource::Named(address) => Some(address),
                };
                !leads && chosen().is_some_and(|chosen| chosen != remote.discovery)
            })
            .map(|(prefix, _)| *prefix)
            .collect();
        for prefix in moved {
            self.relocate_participant(now, prefix);
        }
        self.announce_soon(now);
        self.publish_changes();
    }

    /// Announces the new locators of the local endpoints.
    fn reannounce_endpoints(&mut self, now: Instant) {
        let user = self.own.user.clone();
        let mut ends = Vec::new();
        for (entity, writer) in &mut self.writers {
            if !entity.is_builtin() && writer.leaves.is_none() {
                writer.state.own.unicast.clone_from(&user);
                ends.push(writer.state.own.clone());
            }
        }
        for (entity, reader) in &mut self.readers {
            if !entity.is_builtin() {
                reader.state.own.unicast.clone_from(&user);
                ends.push(reader.state.own.clone());
            }
        }
        for end in ends {
            self.announce_endpoint(now, &end);
        }
    }

    /// Rediscovers a participant at another address.
    fn relocate_participant(&mut self, now: Instant, prefix: GuidPrefix) {
        let Some(remote) = self.remotes.get(&prefix) else {
            return;
        };
        let (told, via) = ((*remote.data).clone(), remote.via);
        self.rematch_participant(now, via, told);
    }
}
