//! Which participants of DDS this daemon has in a servant's network, written down in the servant's directory. A daemon that is killed
//! cannot say that they are gone; the next one says it in their names.

use std::collections::BTreeMap;
use std::sync::Arc;

use async_trait::async_trait;
use ros::{ParticipantPrefix, Succession};
use serde::{Deserialize, Serialize};
use servant::local::LocalServant;
use tokio::sync::Mutex;

/// So many of earlier daemons are kept, those of the last ones: a daemon may be killed before it has told the others.
const EARLIER: usize = 8;

/// Those of one servant.
#[derive(Debug)]
pub(crate) struct Participants {
    servant: Arc<LocalServant>,
    /// None until it was looked what earlier daemons had.
    known: Mutex<Option<Known>>,
}

#[derive(Debug, Default)]
struct Known {
    /// Of earlier daemons, the oldest first.
    earlier: Vec<ParticipantPrefix>,
    /// Of this daemon, by the names of their nodes, which are there once.
    own: BTreeMap<String, ParticipantPrefix>,
}

/// As it is written down: the oldest first.
#[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
struct Left {
    participants: Vec<ParticipantPrefix>,
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
    fn after(left: Left) -> Known {
        let mut earlier = left.participants;
        earlier.drain(..earlier.len().saturating_sub(EARLIER));
        Known {
            earlier,
            own: BTreeMap::new(),
        }
    }

    fn joins(&mut self, node: &str, participant: ParticipantPrefix) -> Left {
        self.own.insert(node.to_owned(), participant);
        let all = self.earlier.iter().chain(self.own.values());
        Left {
            participants: all.copied().collect(),
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
                none.insert(Known::after(left.unwrap_or_default()))
            }
        };
        // Before it joins: whoever knows it may be told by the next daemon that it is gone.
        if let Err(error) = self.servant.leave(known.joins(node, participant)).await {
            tracing::warn!(%error, "nodes of ROS 2 may wait for this daemon after it was killed");
        }
        known.earlier.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_next_daemon_is_told_of_every_node_of_the_last_ones() {
        let mut known = Known::after(Left::default());
        assert!(known.earlier.is_empty());
        known.joins("/bridge", [1; 12]);
        known.joins("/inside", [2; 12]);
        // It comes anew, and had left.
        let left = known.joins("/inside", [3; 12]);
        assert_eq!(left.participants, [[1; 12], [3; 12]]);
        let mut next = Known::after(left);
        assert_eq!(next.earlier, [[1; 12], [3; 12]]);
        // Killed before it has told anybody.
        let mut left = next.joins("/bridge", [4; 12]);
        assert_eq!(left.participants, [[1; 12], [3; 12], [4; 12]]);
        left.participants.extend((5..12).map(|number| [number; 12]));
        let last = Known::after(left);
        let expected: Vec<_> = (4..12).map(|number| [number; 12]).collect();
        assert_eq!(last.earlier, expected);
    }
}
