//! Participants that this one replaces and that ended without a farewell, as a killed process does. Others would
//! believe them alive until their leases expire, and send them requests. Therefore their disposal is announced in their
//! names (8.5.3) whenever this participant is announced.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use super::Engine;
use crate::{GuidPrefix, SequenceNumber};

/// A receiver ignores samples of a participant with numbers lower than it has seen. Predecessors have sent fewer than
/// this.
const LAST_WORD: SequenceNumber = SequenceNumber(1 << 32);

/// The participants that are gone.
pub(super) struct Predecessors {
    prefixes: Vec<GuidPrefix>,
    /// Time at which all their leases have expired.
    until: Option<Instant>,
}

impl Predecessors {
    /// Creates the list of participants that were killed before now and had this lease; without a lease they are
    /// announced forever.
    pub fn new(now: Instant, prefixes: Vec<GuidPrefix>, lease: Option<Duration>) -> Self {
        let until = lease.map(|lease| now + lease);
        Self { prefixes, until }
    }

    /// Forgets participants whose leases have expired.
    pub fn remove_expired(&mut self, now: Instant) {
        if self.until.is_some_and(|until| until <= now) {
            self.prefixes.clear();
        }
    }
}

impl Engine {
    /// Announces the disposal of the predecessors. Repeated because datagrams may be lost; receivers ignore duplicates.
    pub(super) fn dispose_predecessors(&mut self, to: SocketAddr, prefix: GuidPrefix) {
        for gone in self.predecessors.prefixes.clone() {
            self.send_disposal(gone, LAST_WORD, to, prefix);
        }
    }
}
