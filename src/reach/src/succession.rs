//! Records in the servant's directory which DDS participants this daemon has in a servant's network. A daemon that is
//! killed cannot announce their departure; the next one does so in their names.

use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use async_trait::async_trait;
use ros::{ParticipantPrefix, Succession};
use serde::{Deserialize, Serialize};
use servant::local::LocalServant;
use tokio::sync::Mutex;

/// Maximum number of participants of earlier daemons that are kept, the latest ones: a daemon may be killed before it
/// has announced them.
const EARLIER: usize = 8;
/// Lease duration of `rtps` participants: others may believe in them this long after a daemon has ended.
const LEASE: Duration = Duration::from_secs(10);

/// The participants of the daemon in one servant.
#[derive(Debug)]
pub(crate) struct DaemonParticipants {
    servant: Arc<LocalServant>,
    /// `None` until the record of earlier daemons was read.
    known: Mutex<Option<ParticipantLedger>>,
}

#[derive(Debug)]
struct ParticipantLedger {
    left: PersistedParticipants,
    since: Instant,
}

/// The persistent record.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
struct PersistedParticipants {
    /// Id of the daemon run that wrote this.
    run: u64,
    /// Participants of earlier runs, oldest first.
    earlier: Vec<ParticipantPrefix>,
    /// Participants of that run by their unique node names.
    own: BTreeMap<String, ParticipantPrefix>,
}

/// Returns an id unique to this run of the daemon.
fn this_run() -> u64 {
    static RUN: OnceLock<u64> = OnceLock::new();
    *RUN.get_or_init(rand::random)
}

impl DaemonParticipants {
    pub(crate) fn new(servant: &Arc<LocalServant>) -> DaemonParticipants {
        DaemonParticipants { servant: Arc::clone(servant), known: Mutex::default() }
    }
}

impl ParticipantLedger {
    /// Creates the record of a run from what was read.
    fn from_persisted(run: u64, mut left: PersistedParticipants, since: Instant) -> ParticipantLedger {
        // Participants recorded by this run are alive.
        if left.run != run {
            left.earlier.extend(std::mem::take(&mut left.own).into_values());
            let surplus = left.earlier.len().saturating_sub(EARLIER);
            left.earlier.drain(..surplus);
            left.run = run;
        }
        ParticipantLedger { left, since }
    }

    fn record_join(&mut self, node: &str, participant: ParticipantPrefix) -> PersistedParticipants {
        self.left.own.insert(node.to_owned(), participant);
        self.left.clone()
    }

    /// Returns the participants whose departure must be announced now.
    fn gone_participants(&self, now: Instant) -> Vec<ParticipantPrefix> {
        let is_believed = now.duration_since(self.since) < LEASE;
        if is_believed { self.left.earlier.clone() } else { Vec::new() }
    }
}

#[async_trait]
impl Succession for DaemonParticipants {
    async fn record_join(&self, node: &str, participant: ParticipantPrefix) -> Vec<ParticipantPrefix> {
        let mut known = self.known.lock().await;
        let known = match &mut *known {
            Some(known) => known,
            none => {
                let left = self.servant.load_handover().await.unwrap_or_else(|error| {
                    tracing::warn!(%error, "ROS 2 nodes may wait for an earlier daemon until its lease expires");
                    None
                });
                none.insert(ParticipantLedger::from_persisted(this_run(), left.unwrap_or_default(), Instant::now()))
            }
        };
        // Recorded before it joins, so that the next daemon announces its departure to everybody who knows it.
        if let Err(error) = self.servant.save_handover(known.record_join(node, participant)).await {
            tracing::warn!(%error, "ROS 2 nodes may wait for this daemon after it was killed");
        }
        known.gone_participants(Instant::now())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_next_daemon_is_told_of_every_node_of_the_last_ones() {
        let now = Instant::now();
        let mut known = ParticipantLedger::from_persisted(1, PersistedParticipants::default(), now);
        assert!(known.gone_participants(now).is_empty());
        known.record_join("/bridge", [1; 12]);
        known.record_join("/inside", [2; 12]);
        // It leaves and joins again.
        let left = known.record_join("/inside", [3; 12]);
        let mut next = ParticipantLedger::from_persisted(2, left, now);
        assert_eq!(next.gone_participants(now), [[1; 12], [3; 12]]);
        // Killed before it has announced anything.
        let mut left = next.record_join("/bridge", [4; 12]);
        left.earlier.splice(..0, (5..12).map(|number| [number; 12]));
        let last = ParticipantLedger::from_persisted(3, left, now);
        let expected: Vec<_> = (7..12).chain([1, 3, 4]).map(|number| [number; 12]).collect();
        assert_eq!(last.gone_participants(now), expected);
    }

    #[test]
    fn nobody_is_told_that_those_of_this_daemon_are_gone() {
        let now = Instant::now();
        let left =
            ParticipantLedger::from_persisted(1, PersistedParticipants::default(), now).record_join("/bridge", [1; 12]);
        let mut again = ParticipantLedger::from_persisted(1, left, now);
        assert!(again.gone_participants(now).is_empty());
        // The next one announces all.
        let left = again.record_join("/inside", [2; 12]);
        assert_eq!(ParticipantLedger::from_persisted(2, left, now).gone_participants(now), [[1; 12], [2; 12]]);
    }

    #[test]
    fn nobody_is_told_of_those_in_whom_nobody_believes_any_more() {
        let now = Instant::now();
        let left =
            ParticipantLedger::from_persisted(1, PersistedParticipants::default(), now).record_join("/bridge", [1; 12]);
        let mut next = ParticipantLedger::from_persisted(2, left, now);
        assert_eq!(next.gone_participants(now).len(), 1);
        assert!(next.gone_participants(now + LEASE).is_empty());
        // They remain recorded until later ones replace them.
        assert_eq!(next.record_join("/bridge", [2; 12]).earlier, [[1; 12]]);
    }
}
