//! Endpoints of the robot's topics with incompatible quality of service, which exchange no messages. The bus reports
//! them in the robot's log; the cloud receives the current list, for `cloudroidctl explain`.

use std::sync::atomic::Ordering;
use std::sync::{Arc, Weak};
use std::time::Duration;

use link::control::{FromRobot, IncompatibleEndpoint};
use ros::bus::MatchedPeers;

use super::state::{Mirror, Refusals};

/// Interval between checks.
const PERIOD: Duration = Duration::from_secs(1);

/// A local endpoint; dropping it removes its incompatible peers.
pub struct LocalEnd {
    refusals: Arc<Refusals>,
    number: u64,
    topic: String,
}

impl Refusals {
    /// Adds a local endpoint.
    pub fn register_end(self: &Arc<Self>, topic: &str) -> LocalEnd {
        LocalEnd {
            refusals: Arc::clone(self),
            number: self.next.fetch_add(1, Ordering::Relaxed),
            topic: topic.to_owned(),
        }
    }

    /// Returns all current incompatible endpoints without duplicates.
    fn current(&self) -> Vec<IncompatibleEndpoint> {
        let known = self.known.lock();
        let mut all: Vec<IncompatibleEndpoint> = known.values().flatten().cloned().collect();
        all.sort();
        all.dedup();
        all.truncate(IncompatibleEndpoint::MAX_ENDPOINTS);
        all
    }
}

impl LocalEnd {
    /// Replaces the incompatible peers of the endpoint.
    pub fn update(&self, matched: &MatchedPeers) {
        let refused = matched.refused.iter().map(|refusal| IncompatibleEndpoint {
            topic: self.topic.clone(),
            node: refusal.peer.node().to_owned(),
            why: refusal.why.clone(),
        });
        let refused: Vec<IncompatibleEndpoint> = refused.collect();
        let mut known = self.refusals.known.lock();
        if refused.is_empty() {
            known.remove(&self.number)
        } else {
            known.insert(self.number, refused)
        };
    }
}

impl Drop for LocalEnd {
    fn drop(&mut self) {
        self.refusals.known.lock().remove(&self.number);
    }
}

/// Reports incompatible endpoints until the mirror is gone.
pub async fn report_loop(mirror: Weak<Mirror>) {
    let mut told = (Weak::new(), Vec::new());
    loop {
        tokio::time::sleep(PERIOD).await;
        let Some(mirror) = mirror.upgrade() else {
            return;
        };
        let session = mirror.session();
        // While the link is down, every change would queue another report.
        if !session.is_up() {
            continue;
        }
        if !Weak::ptr_eq(&told.0, &Arc::downgrade(&session)) {
            // The cloud of another session has received no report yet.
            told = (Arc::downgrade(&session), Vec::new());
        }
        let all = mirror.refusals.current();
        if told.1 != all {
            session.send_control(&FromRobot::Refused(all.clone()));
            told.1 = all;
        }
    }
}

#[cfg(test)]
mod tests {
    use ros::bus::{IncompatiblePeer, PeerId};

    use super::*;

    fn refusing(node: &str) -> MatchedPeers {
        MatchedPeers {
            refused: vec![IncompatiblePeer { peer: PeerId::new(node, 1), why: "reliability".to_owned() }],
            ..MatchedPeers::default()
        }
    }

    #[test]
    fn what_no_longer_stands_is_no_longer_told() {
        let refusals = Arc::new(Refusals::default());
        let [seen, scan] = ["/seen", "/scan"].map(|topic| refusals.register_end(topic));
        let again = refusals.register_end("/seen");
        for end in [&seen, &scan, &again] {
            end.update(&refusing("/viewer"));
        }
        let told =
            |refusals: &Refusals| -> Vec<String> { refusals.current().into_iter().map(|one| one.topic).collect() };
        assert_eq!(told(&refusals), ["/scan", "/seen"]);
        scan.update(&MatchedPeers::default());
        drop(seen);
        assert_eq!(told(&refusals), ["/seen"], "by the other end");
        drop(again);
        assert!(refusals.current().is_empty());
    }
}
