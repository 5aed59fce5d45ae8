//! Endpoints of a topic that exchange no messages because their quality of service is incompatible: each is reported
//! once.

use ros::bus::{MatchedPeers, PeerId};

/// Maximum number of endpoints reported.
const MAX_ENDPOINTS: usize = 64;

/// Incompatible endpoints of one topic.
#[derive(Debug, Default)]
pub(crate) struct Refusals {
    /// The endpoints, with the message for the client.
    known: Vec<(PeerId, String)>,
}

impl Refusals {
    /// Returns the messages for new endpoints. Endpoints that have left, or match by now, are reported again if they
    /// come back.
    pub(crate) fn update(&mut self, matched: &MatchedPeers) -> Vec<String> {
        let refused = &matched.refused;
        self.known.retain(|(peer, _)| refused.iter().any(|refusal| refusal.peer == *peer));
        let mut new = Vec::new();
        for refusal in refused {
            let is_known = self.known.iter().any(|(peer, _)| *peer == refusal.peer);
            if is_known || self.known.len() >= MAX_ENDPOINTS {
                continue;
            }
            let told = format!("no messages pass between {} and this client: {}", refusal.peer, refusal.why);
            self.known.push((refusal.peer.clone(), told.clone()));
            new.push(told);
        }
        new
    }

    /// Iterates over the messages of all current endpoints.
    pub(crate) fn reasons(&self) -> impl Iterator<Item = &str> {
        self.known.iter().map(|(_, told)| told.as_str())
    }
}

#[cfg(test)]
mod tests {
    use ros::bus::IncompatiblePeer;

    use super::*;

    fn refused_by(peers: &[(&str, u128)]) -> MatchedPeers {
        let refused = peers.iter().map(|(node, number)| IncompatiblePeer {
            peer: PeerId::new(*node, *number),
            why: "reliability: the publisher offers best_effort, the subscriber asks for reliable".to_owned(),
        });
        MatchedPeers { refused: refused.collect(), ..MatchedPeers::default() }
    }

    #[test]
    fn each_end_is_told_once_while_it_is_there() {
        let mut refusals = Refusals::default();
        assert_eq!(
            refusals.update(&refused_by(&[("/camera", 1)])),
            ["no messages pass between /camera and this client: reliability: the publisher offers best_effort, the \
                    subscriber asks for reliable"]
        );
        assert_eq!(refusals.update(&refused_by(&[("/camera", 1)])).len(), 0);
        assert_eq!(refusals.update(&refused_by(&[("/camera", 1), ("/camera", 2)])).len(), 1);
        assert_eq!(refusals.reasons().count(), 2);
        assert_eq!(refusals.update(&MatchedPeers::default()).len(), 0);
        assert_eq!(refusals.reasons().count(), 0);
        assert_eq!(refusals.update(&refused_by(&[("/camera", 1)])).len(), 1);
    }

    #[test]
    fn ends_without_number_are_not_told_without_number() {
        let many: Vec<_> = (0..1000).map(|number| ("/hostile", number)).collect();
        let mut refusals = Refusals::default();
        assert_eq!(refusals.update(&refused_by(&many)).len(), MAX_ENDPOINTS);
        assert_eq!(refusals.update(&refused_by(&many)).len(), 0);
    }
}
