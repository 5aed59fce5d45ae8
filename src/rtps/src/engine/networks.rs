//! Networks of this machine that come and go while it takes part.

use std::time::Instant;

use super::Engine;
use super::servers::Via;
use crate::GuidPrefix;
use crate::locator::Locator;
use crate::network::Network;

impl Engine {
    /// The ports at which this participant hears of others, and at which its ends receive.
    pub(super) fn own_ports(&self) -> (u16, u16) {
        let port = |locators: &[Locator]| {
            let first = locators.first();
            first.map_or(0, |locator| u16::try_from(locator.port).unwrap_or(0))
        };
        (port(&self.own.discovery), port(&self.own.user))
    }

    /// The interfaces of this machine are others now: others are told where we are, and those whose network
    /// is gone are sent to elsewhere, where they are elsewhere, too.
    pub fn network_changed(&mut self, now: Instant, network: Network) {
        if network == self.network {
            return;
        }
        let (discovery, user) = self.own_ports();
        self.network = network;
        let (discovery, user) = (
            self.network.locators(discovery),
            self.network.locators(user),
        );
        if (&discovery, &user) != (&self.own.discovery, &self.own.user) {
            self.own.discovery = discovery;
            self.own.user = user;
            if self.is_client() {
                self.announce_self(now);
            }
            self.announce_ends_again(now);
        }
        let moved: Vec<GuidPrefix> = self
            .remotes
            .iter()
            .filter(|(_, remote)| {
                let leads = self.network.leads_to(remote.discovery.ip());
                let told = &remote.data.discovery;
                let chosen = || match remote.via {
                    Via::Itself(source) => self.network.choose(told, Some(source)),
                    Via::Servers => self.network.choose(told, None),
                    Via::Named(address) => Some(address),
                };
                !leads && chosen().is_some_and(|chosen| chosen != remote.discovery)
            })
            .map(|(prefix, _)| *prefix)
            .collect();
        for prefix in moved {
            self.participant_moved(now, prefix);
        }
        self.announce_soon(now);
        self.tell();
    }

    /// Our ends receive elsewhere.
    fn announce_ends_again(&mut self, now: Instant) {
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
            self.announce_end(now, &end);
        }
    }

    /// A participant is reached elsewhere: it is met anew there.
    fn participant_moved(&mut self, now: Instant, prefix: GuidPrefix) {
        let Some(remote) = self.remotes.get(&prefix) else {
            return;
        };
        let (told, via) = ((*remote.data).clone(), remote.via);
        self.participant_met_anew(now, via, told);
    }
}
