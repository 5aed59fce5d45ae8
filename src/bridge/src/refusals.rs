//! Ends of a topic with which no messages pass, because both ask for different things: each is told once.

use ros::bus::{Matched, PeerId};

/// Ends told of at most; who makes more of them is told of these.
const MOST: usize = 64;

/// What is known of one topic's ends.
#[derive(Debug, Default)]
pub(crate) struct Refusals {
    /// Each with what its client is told.
    known: Vec<(PeerId, String)>,
}

impl Refusals {
    /// Those that are new. Ends that have left, or match by now, are told again should they come back.
    pub(crate) fn update(&mut self, matched: &Matched) -> Vec<String> {
        let refused = &matched.refused;
        self.known
            .retain(|(peer, _)| refused.iter().any(|refusal| refusal.peer == *peer));
        let mut new = Vec::new();
        for refusal in refused {
            let is_known = self.known.iter().any(|(peer, _)| *peer == refusal.peer);
            if is_known || self.known.len() >= MOST {
                continue;
            }
            let told = format!(
                "nothing passes between {} and this client: {}",
                refusal.peer, refusal.why
            );
            self.known.push((refusal.peer.clone(), told.clone()));
            new.push(told);
        }
        new
    }

    /// All there are.
    pub(crate) fn known(&self) -> impl Iterator<Item = &str> {
        self.known.iter().map(|(_, told)| told.as_str())
    }
}

#[cfg(test)]
mod tests {
    use ros::bus::Refusal;

    use super::*;

    fn refused(peers: &[(&str, u128)]) -> Matched {
        let refused = peers.iter().map(|(node, number)| Refusal {
            peer: PeerId::new(*node, *number),
            why: "reliability: the publisher offers best_effort, the subscriber asks for reliable"
                .to_owned(),
        });
        Matched {
            refused: refused.collect(),
            ..Matched::default()
        }
    }

    #[test]
    fn each_end_is_told_once_while_it_is_there() {
        let mut refusals = Refusals::default();
        assert_eq!(
            refusals.update(&refused(&[("/camera", 1)])),
            [
                "nothing passes between /camera and this client: reliability: the publisher offers best_effort, the subscriber asks for reliable"
            ]
        );
        assert_eq!(refusals.update(&refused(&[("/camera", 1)])).len(), 0);
        assert_eq!(
            refusals
                .update(&refused(&[("/camera", 1), ("/camera", 2)]))
                .len(),
            1
        );
        assert_eq!(refusals.known().count(), 2);
        assert_eq!(refusals.update(&Matched::default()).len(), 0);
        assert_eq!(refusals.known().count(), 0);
        assert_eq!(refusals.update(&refused(&[("/camera", 1)])).len(), 1);
    }

    #[test]
    fn ends_without_number_are_not_told_without_number() {
        let many: Vec<_> = (0..1000).map(|number| ("/hostile", number)).collect();
        let mut refusals = Refusals::default();
        assert_eq!(refusals.update(&refused(&many)).len(), MOST);
        assert_eq!(refusals.update(&refused(&many)).len(), 0);
    }
}
