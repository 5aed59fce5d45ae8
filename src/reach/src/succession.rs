//! Which participants of DDS this daemon has in a servant's network, written down in the servant's directory. A daemon that is killed
//! cannot say that they are gone; the next one says it in their names.

use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use async_trait::async_trait;
use ros::{ParticipantPrefix, Succession};
use serde::{Deserialize, Serialize};
use servant::local::LocalServant;
use tokio::sync::Mutex;

/// So many of earlier daemons are kept, those of the last ones: a daemon may be killed before it has told the others.
const EARLIER: usize = 8;
/// The lease of crate `rtps`'s participants: so long after a daemon has ended somebody may believe in them.
const BELIEVED: Duration = Duration::from_secs(10);

/// Those of one servant.
#[derive(Debug)]
pub(crate) struct Participants {
    servant: Arc<LocalServant>,
    /// None until it was looked what earlier daemons had.
    known: Mutex<Option<Known>>,
}

#[derive(Debug)]
struct Known {
    left: Left,
    since: Instant,
}

/// As it is written down.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
struct Left {
    /// Which run of the daemon wrote this.
    run: u64,
    /// Of earlier daemons, the oldest first.
    earlier: Vec<ParticipantPrefix>,
    /// Of that run, by the names of their nodes, which are there once.
    own: BTreeMap<String, ParticipantPrefix>,
}

/// A number that no other run of the daemon has.
fn this_run() -> u64 {
    static RUN: OnceLock<u64> = OnceLock::new();
    *RUN.get_or_init(rand::random)
}

impl Participants {
    pub(crate) fn of(servant: &Arc<LocalServant>) -> Participants {
        Participants {
            servant: Arc::clone(servant),
            known: Mutex::default(),
        }
    }
}

impl Known {
    /// What a run of the daemon finds.
    fn found(run: u64, mut left: Left, since: Instant) -> Known {
        // What this run has written is of participants that live.
        if left.run != run {
            left.earlier
                .extend(std::mem::take(&mut left.own).into_values());
            let surplus = left.earlier.len().saturating_sub(EARLIER);
            left.earlier.drain(..surplus);
            left.run = run;
        }
        Known { left, since }
    }

    fn joins(&mut self, node: &str, participant: ParticipantPrefix) -> Left {
        self.left.own.insert(node.to_owned(), participant);
        self.left.clone()
    }

    /// Of whom others are to be told now that they are gone.
    fn gone(&self, now: Instant) -> Vec<ParticipantPrefix> {
        let is_believed = now.duration_since(self.since) < BELIEVED;
        if is_believed {
            self.left.earlier.clone()
        } else {
            Vec::new()
        }
    }
}

#[async_trait]
impl Succession for Participants {
    async fn joins(&self, node: &str, participant: ParticipantPrefix) -> Vec<ParticipantPrefix> {
        let mut known = self.known.lock().await;
        let known = match &mut *known {
            Some(known) => known,
            none => {
                let left = self.servant.left().await.unwrap_or_else(|error| {
                    tracing::warn!(%error, "nodes of ROS 2 may wait for an earlier daemon until its lease is over");
                    None
                });
                none.insert(Known::found(
                    this_run(),
                    left.unwrap_or_default(),
                    Instant::now(),
                ))
            }
        };
        // Before it joins: whoever knows it may be told by the next daemon that it is gone.
        if let Err(error) = self.servant.leave(known.joins(node, participant)).await {
            tracing::warn!(%error, "nodes of ROS 2 may wait for this daemon after it was killed");
        }
        known.gone(Instant::now())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_next_daemon_is_told_of_every_node_of_the_last_ones() {
        let now = Instant::now();
        let mut known = Known::found(1, Left::default(), now);
        assert!(known.gone(now).is_empty());
        known.joins("/bridge", [1; 12]);
        known.joins("/inside", [2; 12]);
        // It comes anew, and had left.
        let left = known.joins("/inside", [3; 12]);
        let mut next = Known::found(2, left, now);
        assert_eq!(next.gone(now), [[1; 12], [3; 12]]);
        // Killed before it has told anybody.
        let mut left = next.joins("/bridge", [4; 12]);
        left.earlier.splice(..0, (5..12).map(|number| [number; 12]));
        let last = Known::found(3, left, now);
        let expected: Vec<_> = (7..12)
            .chain([1, 3, 4])
            .map(|number| [number; 12])
            .collect();
        assert_eq!(last.gone(now), expected);
    }

    #[test]
    fn nobody_is_told_that_those_of_this_daemon_are_gone() {
        let now = Instant::now();
        let left = Known::found(1, Left::default(), now).joins("/bridge", [1; 12]);
        let mut again = Known::found(1, left, now);
        assert!(again.gone(now).is_empty());
        // The next one is told of all.
        let left = again.joins("/inside", [2; 12]);
        assert_eq!(Known::found(2, left, now).gone(now), [[1; 12], [2; 12]]);
    }

    #[test]
    fn nobody_is_told_of_those_in_whom_nobody_believes_any_more() {
        let now = Instant::now();
        let left = Known::found(1, Left::default(), now).joins("/bridge", [1; 12]);
        let mut next = Known::found(2, left, now);
        assert_eq!(next.gone(now).len(), 1);
        assert!(next.gone(now + BELIEVED).is_empty());
        // They are written down all the same, until later ones take their places.
        assert_eq!(next.joins("/bridge", [2; 12]).earlier, [[1; 12]]);
    }
}
