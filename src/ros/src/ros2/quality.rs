//! Quality of service as the bus has it, and as DDS has it.

use rtps::{Durability, EndpointData, EndpointQos, History, Liveliness, Mismatch, Reliability};

use super::node_ends::DEPTH;
use crate::bus::{self, Qos};

/// What decides which publishers a subscription hears: in no other policy does it ask for anything.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct Quality {
    pub(super) reliability: Reliability,
    pub(super) durability: Durability,
}

impl Quality {
    /// What is wished for.
    pub(super) fn of(qos: &Qos) -> Self {
        Self {
            reliability: match qos.reliability {
                bus::Reliability::Reliable => Reliability::Reliable,
                bus::Reliability::BestEffort => Reliability::BestEffort,
            },
            durability: match qos.durability {
                bus::Durability::Volatile => Durability::Volatile,
                bus::Durability::TransientLocal => Durability::TransientLocal,
            },
        }
    }

    /// What of this a writer offers.
    pub(super) fn at_most(self, offered: &EndpointQos) -> Self {
        Self {
            reliability: self.reliability.min(offered.reliability),
            durability: self.durability.min(offered.durability),
        }
    }
}

/// As a writer of ours has it: what is said of time, too.
pub(super) fn offered(qos: &Qos) -> EndpointQos {
    EndpointQos {
        deadline: qos.deadline,
        lifespan: qos.lifespan,
        liveliness: match qos.liveliness {
            bus::Liveliness::Automatic => Liveliness::Automatic,
            bus::Liveliness::ManualByTopic => Liveliness::ManualByTopic,
        },
        lease: qos.lease,
        ..endpoint(Quality::of(qos), qos.depth)
    }
}

/// As a reader of ours has it, which asks for nothing else.
pub(super) fn endpoint(quality: Quality, depth: usize) -> EndpointQos {
    EndpointQos {
        reliability: quality.reliability,
        durability: quality.durability,
        history: History::KeepLast(u32::try_from(depth.max(1)).unwrap_or(u32::MAX)),
        ..EndpointQos::default()
    }
}

/// What an end of another node says of itself.
pub(super) fn of_end(qos: &EndpointQos) -> Qos {
    Qos {
        reliability: match qos.reliability {
            Reliability::Reliable => bus::Reliability::Reliable,
            Reliability::BestEffort => bus::Reliability::BestEffort,
        },
        durability: match qos.durability {
            Durability::Volatile => bus::Durability::Volatile,
            _ => bus::Durability::TransientLocal,
        },
        depth: match qos.history {
            History::KeepLast(depth) => usize::try_from(depth).unwrap_or(usize::MAX).max(1),
            History::KeepAll => DEPTH,
        },
        deadline: qos.deadline,
        lifespan: qos.lifespan,
        liveliness: match qos.liveliness {
            Liveliness::ManualByTopic => bus::Liveliness::ManualByTopic,
            _ => bus::Liveliness::Automatic,
        },
        lease: qos.lease,
    }
}

/// What two ends on one topic are as one: a publisher offers the most of both, a subscriber asks for the least.
pub(crate) fn joined(one: Qos, two: Qos, publishes: bool) -> Qos {
    let reliable = [one, two].map(|it| it.reliability == bus::Reliability::Reliable);
    let latching = [one, two].map(|it| it.is_latching());
    let both = |of: [bool; 2]| match publishes {
        true => of[0] || of[1],
        false => of[0] && of[1],
    };
    let joined = Qos {
        reliability: match both(reliable) {
            true => bus::Reliability::Reliable,
            false => bus::Reliability::BestEffort,
        },
        depth: one.depth.max(two.depth),
        ..one
    };
    joined.latching(both(latching))
}

/// Why no messages pass between a writer and a reader, with all that both say.
pub(super) fn refusal(why: &[Mismatch], offered: &EndpointQos, requested: &EndpointQos) -> String {
    let reasons: Vec<String> = why.iter().map(Mismatch::to_string).collect();
    format!(
        "{} (publisher: {}; subscriber: {})",
        reasons.join("; "),
        profile(offered),
        profile(requested)
    )
}

/// A profile in the words of ROS 2's tools; what has no end is left out.
fn profile(qos: &EndpointQos) -> String {
    let mut words = vec![qos.reliability.to_string(), qos.durability.to_string()];
    let lease = qos
        .lease
        .is_some()
        .then(|| format!("liveliness {}", qos.liveliness));
    words.extend(lease);
    let times = [
        ("deadline", qos.deadline),
        ("lifespan", qos.lifespan),
        ("liveliness lease", qos.lease),
    ];
    words.extend(
        times
            .iter()
            .filter_map(|(what, time)| time.map(|time| format!("{what} {} s", time.as_secs_f64()))),
    );
    words.join(", ")
}

/// Whether a writer keeps its last messages for those who come later.
pub(super) fn is_latching(writer: &EndpointData) -> bool {
    writer.qos.durability >= Durability::TransientLocal
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_wish_is_granted_as_far_as_it_is_offered() {
        let wish = Quality::of(&Qos::keep_last(5).latching(true));
        let offered = EndpointQos {
            reliability: Reliability::BestEffort,
            durability: Durability::Persistent,
            ..EndpointQos::default()
        };
        let granted = wish.at_most(&offered);
        assert_eq!(
            (granted.reliability, granted.durability),
            (Reliability::BestEffort, Durability::TransientLocal)
        );
        assert_eq!(offered.mismatches(&endpoint(granted, 5)), []);
        assert_eq!(endpoint(wish, 0).history, History::KeepLast(1));
    }

    #[test]
    fn a_refusal_says_both_profiles() {
        let offered = EndpointQos {
            reliability: Reliability::BestEffort,
            ..EndpointQos::default()
        };
        let requested = EndpointQos {
            deadline: Some(Duration::from_millis(100)),
            ..EndpointQos::default()
        };
        let why = refusal(&offered.mismatches(&requested), &offered, &requested);
        assert_eq!(
            why,
            "reliability: the publisher offers best_effort, the subscriber asks for reliable; \
             deadline: the publisher offers infinite, the subscriber asks for 0.1 s \
             (publisher: best_effort, volatile; subscriber: reliable, volatile, deadline 0.1 s)"
        );
    }
}
