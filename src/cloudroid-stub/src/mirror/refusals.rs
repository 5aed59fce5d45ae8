//! Ends of the robot's topics with which no messages pass, since they ask for what is not offered. The robot's log has them by the bus; the
//! cloud is told all that there are now, for whoever explains.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Weak};
use std::time::Duration;

use link::control::{FromRobot, Refused};
use parking_lot::Mutex;
use ros::bus::Matched;

use super::Mirror;

/// Between two looks.
const PERIOD: Duration = Duration::from_secs(1);

/// By the numbers of our own ends.
#[derive(Default)]
pub struct Refusals {
    known: Mutex<BTreeMap<u64, Vec<Refused>>>,
    next: AtomicU64,
}

/// One of our own ends; when it goes, so does what was known of it.
pub struct End {
    refusals: Arc<Refusals>,
    number: u64,
    topic: String,
}

impl Refusals {
    /// A further end of ours.
    pub fn end(self: &Arc<Self>, topic: &str) -> End {
        End {
            refusals: Arc::clone(self),
            number: self.next.fetch_add(1, Ordering::Relaxed),
            topic: topic.to_owned(),
        }
    }

    /// All there are, each once.
    fn all(&self) -> Vec<Refused> {
        let known = self.known.lock();
        let mut all: Vec<Refused> = known.values().flatten().cloned().collect();
        all.sort();
        all.dedup();
        all.truncate(Refused::MOST);
        all
    }
}

impl End {
    /// Who is at the other end now.
    pub fn meets(&self, matched: &Matched) {
        let refused = matched.refused.iter().map(|refusal| Refused {
            topic: self.topic.clone(),
            node: refusal.peer.node().to_owned(),
            why: refusal.why.clone(),
        });
        let refused: Vec<Refused> = refused.collect();
        let mut known = self.refusals.known.lock();
        match refused.is_empty() {
            true => known.remove(&self.number),
            false => known.insert(self.number, refused),
        };
    }
}

impl Drop for End {
    fn drop(&mut self) {
        self.refusals.known.lock().remove(&self.number);
    }
}

/// Until the mirror is gone.
pub async fn report(mirror: Weak<Mirror>) {
    let mut told = (Weak::new(), Vec::new());
    loop {
        tokio::time::sleep(PERIOD).await;
        let Some(mirror) = mirror.upgrade() else {
            return;
        };
        let session = mirror.session();
        // What waits for a link that is away would be one report more with each change.
        if !session.is_up() {
            continue;
        }
        if !Weak::ptr_eq(&told.0, &Arc::downgrade(&session)) {
            // Another session's cloud was told nothing yet.
            told = (Arc::downgrade(&session), Vec::new());
        }
        let all = mirror.refusals.all();
        if told.1 != all {
            session.report(&FromRobot::Refused(all.clone()));
            told.1 = all;
        }
    }
}

#[cfg(test)]
mod tests {
    use ros::bus::{PeerId, Refusal};

    use super::*;

    fn refusing(node: &str) -> Matched {
        Matched {
            refused: vec![Refusal {
                peer: PeerId::new(node, 1),
                why: "reliability".to_owned(),
            }],
            ..Matched::default()
        }
    }

    #[test]
    fn what_no_longer_stands_is_no_longer_told() {
        let refusals = Arc::new(Refusals::default());
        let [seen, scan] = ["/seen", "/scan"].map(|topic| refusals.end(topic));
        let again = refusals.end("/seen");
        for end in [&seen, &scan, &again] {
            end.meets(&refusing("/viewer"));
        }
        let told = |refusals: &Refusals| -> Vec<String> {
            refusals.all().into_iter().map(|one| one.topic).collect()
        };
        assert_eq!(told(&refusals), ["/scan", "/seen"]);
        scan.meets(&Matched::default());
        drop(seen);
        assert_eq!(told(&refusals), ["/seen"], "by the other end");
        drop(again);
        assert!(refusals.all().is_empty());
    }
}
