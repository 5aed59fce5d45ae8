//! Participants in whose place this one comes and that ended without a word, as a process does that is killed. Others would take
//! them for alive until their leases are over, and send them requests; so they are told in the predecessors' names that these are gone
//! (8.5.3), whenever they are told of this one.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use super::Engine;
use crate::{GuidPrefix, SequenceNumber};

/// Whoever has heard a participant takes nothing of it with a number that was before. It has not said so much.
const LAST_WORD: SequenceNumber = SequenceNumber(1 << 32);

/// Those who are gone.
pub(super) struct Predecessors {
    prefixes: Vec<GuidPrefix>,
    /// When nobody believes in them any more.
    until: Option<Instant>,
}

impl Predecessors {
    /// They were killed before now, and had this lease; for ever where there is none.
    pub fn new(now: Instant, prefixes: Vec<GuidPrefix>, lease: Option<Duration>) -> Self {
        let until = lease.map(|lease| now + lease);
        Self { prefixes, until }
    }

    /// Forgets those whose leases are over.
    pub fn tidy(&mut self, now: Instant) {
        if self.until.is_some_and(|until| until <= now) {
            self.prefixes.clear();
        }
    }
}

impl Engine {
    /// Says to them that the predecessors are gone. Again and again, as it may be lost; whoever has heard it lets it pass.
    pub(super) fn say_goodbye_of_predecessors(&mut self, to: SocketAddr, prefix: GuidPrefix) {
        for gone in self.predecessors.prefixes.clone() {
            self.say_gone(gone, LAST_WORD, to, prefix);
        }
    }
}
