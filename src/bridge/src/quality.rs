//! What clients ask of the ends of topics, in the words of the bus.

use std::time::Duration;

use ros::bus::{Durability, Liveliness, Qos, Reliability, RosVersion};
use rosbridge::{History, Period, Subscribe};

/// Messages kept per slow node where a client does not say.
const DEFAULT_QUEUE: usize = 100;
/// Most messages kept per slow node.
const MOST_QUEUED: usize = 1000;

/// What a client's publications offer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Offer {
    /// To nodes.
    pub(crate) qos: Qos,
    /// Whether newcomers are given the last message.
    pub(crate) latch: bool,
}

/// What is asked of a topic's publishers where no client says what it wants: as much as they offer, all that they keep
/// included. `depth`: messages that the bus keeps for the bridge.
pub(crate) const fn all_there_is(depth: usize) -> Qos {
    Qos::keep_last(depth).latching(true)
}

/// What a client's subscription asks of publishers. How many messages are kept for the client itself is
/// [another matter](queue_length).
pub(crate) fn asked(qos: Option<rosbridge::Qos>, depth: usize) -> Qos {
    let all = all_there_is(depth);
    let Some(qos) = qos else { return all };
    Qos {
        reliability: match qos.reliability {
            Some(rosbridge::Reliability::BestEffort) => Reliability::BestEffort,
            _ => all.reliability,
        },
        durability: match qos.durability {
            Some(rosbridge::Durability::Volatile) => Durability::Volatile,
            _ => all.durability,
        },
        ..all
    }
}

/// What satisfies all of a client's subscriptions to a topic.
pub(crate) fn most<'q>(all: impl Iterator<Item = &'q Qos>) -> Option<Qos> {
    all.copied().reduce(|one, other| Qos {
        reliability: match one.reliability {
            Reliability::Reliable => Reliability::Reliable,
            Reliability::BestEffort => other.reliability,
        },
        durability: match one.durability {
            Durability::TransientLocal => Durability::TransientLocal,
            Durability::Volatile => other.durability,
        },
        ..one
    })
}

/// The policies that a client speaks of and that mean nothing, in words: to ROS 1, or to a subscription, which asks nothing
/// about time of those that it hears.
pub(crate) fn unheard(
    version: RosVersion,
    qos: &rosbridge::Qos,
    subscribes: bool,
) -> Option<String> {
    if version == RosVersion::Two && !subscribes {
        return None;
    }
    let said = [
        ("qos.deadline", qos.deadline.is_some()),
        ("qos.lifespan", qos.lifespan.is_some()),
        ("qos.liveliness", qos.liveliness.is_some()),
        (
            "qos.liveliness_lease_duration",
            qos.liveliness_lease_duration.is_some(),
        ),
    ];
    let names = said.iter().filter(|(_, is_said)| *is_said);
    let names: Vec<String> = names.map(|(name, _)| format!("{name:?}")).collect();
    if names.is_empty() {
        return None;
    }
    let why = match version {
        RosVersion::One => "this servant speaks ROS 1, which has no such policies",
        RosVersion::Two => "publishers are heard whatever they offer of that",
    };
    Some(format!("{} left out: {why}", names.join(", ")))
}

/// The length of time that a client offers; none where it offers any.
fn offered_period(period: Option<Period>) -> Option<Duration> {
    match period {
        Some(Period::Of(long)) => Some(long),
        Some(Period::Infinite | Period::BestAvailable) | None => None,
    }
}

/// How many messages are kept for a client that subscribes so; 0 where it does not say.
pub(crate) fn queue_length(op: &Subscribe<'_>) -> usize {
    match op.qos {
        Some(qos) if op.queue_length == 0 => match qos.history {
            Some(History::KeepAll) => usize::MAX,
            _ => qos.depth.unwrap_or(0),
        },
        _ => op.queue_length,
    }
}

/// What a client's publications offer: by `qos` where it says it, else by what rosbridge had before.
pub(crate) fn offered(
    version: RosVersion,
    qos: Option<rosbridge::Qos>,
    latch: bool,
    queue_size: Option<u64>,
) -> Offer {
    let qos = qos.unwrap_or_default();
    let latch = match qos.durability {
        Some(rosbridge::Durability::TransientLocal) => true,
        Some(rosbridge::Durability::Volatile) => false,
        Some(rosbridge::Durability::BestAvailable) | None => latch,
    };
    let said = queue_size.filter(|size| *size > 0);
    let depth = match (qos.history, qos.depth) {
        (Some(History::KeepAll), _) => MOST_QUEUED,
        (_, Some(depth)) => depth,
        // So many are given to newcomers: what is latched is the last one.
        (_, None) if latch && version == RosVersion::Two => 1,
        (_, None) => said.map_or(DEFAULT_QUEUE, |size| {
            usize::try_from(size).unwrap_or(usize::MAX)
        }),
    };
    let reliability = match qos.reliability {
        Some(rosbridge::Reliability::BestEffort) => Reliability::BestEffort,
        _ => Reliability::Reliable,
    };
    let liveliness = match qos.liveliness {
        Some(rosbridge::Liveliness::ManualByTopic) => Liveliness::ManualByTopic,
        _ => Liveliness::Automatic,
    };
    let basic = Qos {
        reliability,
        ..Qos::keep_last(depth.min(MOST_QUEUED)).latching(latch)
    };
    let qos = match version {
        RosVersion::One => basic,
        RosVersion::Two => Qos {
            deadline: offered_period(qos.deadline),
            lifespan: offered_period(qos.lifespan),
            liveliness,
            lease: offered_period(qos.liveliness_lease_duration),
            ..basic
        },
    };
    Offer { qos, latch }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use rosbridge::Compression;

    use super::*;

    fn said(qos: rosbridge::Qos) -> Option<rosbridge::Qos> {
        Some(qos)
    }

    #[test]
    fn who_does_not_say_what_it_wants_is_given_all_there_is() {
        let all = all_there_is(256);
        assert!(all.is_latching());
        assert_eq!(asked(None, 256), all);
        assert_eq!(asked(said(rosbridge::Qos::default()), 256), all);
        let deep = rosbridge::Qos {
            depth: Some(5),
            reliability: Some(rosbridge::Reliability::BestAvailable),
            durability: Some(rosbridge::Durability::TransientLocal),
            ..rosbridge::Qos::default()
        };
        assert_eq!(asked(said(deep), 256), all, "its depth is its own queue's");
        let least = rosbridge::Qos {
            reliability: Some(rosbridge::Reliability::BestEffort),
            durability: Some(rosbridge::Durability::Volatile),
            ..rosbridge::Qos::default()
        };
        let least = asked(said(least), 256);
        assert_eq!(least.reliability, Reliability::BestEffort);
        assert_eq!(least.durability, Durability::Volatile);
        assert_eq!(least.depth, 256);
    }

    #[test]
    fn the_depth_is_the_clients_queue_unless_it_says_its_length() {
        let subscribe = |queue_length, qos| Subscribe {
            id: None,
            topic: "/x".into(),
            type_name: None,
            throttle_rate: Duration::ZERO,
            queue_length,
            fragment_size: None,
            compression: Compression::None,
            qos,
        };
        let depth = |depth| rosbridge::Qos {
            depth: Some(depth),
            ..rosbridge::Qos::default()
        };
        let all = rosbridge::Qos {
            history: Some(History::KeepAll),
            ..depth(5)
        };
        for (length, qos, expected) in [
            (0, None, 0),
            (3, None, 3),
            (0, said(depth(5)), 5),
            (3, said(depth(5)), 3),
            (0, said(rosbridge::Qos::default()), 0),
            (0, said(all), usize::MAX),
        ] {
            assert_eq!(queue_length(&subscribe(length, qos)), expected);
        }
    }

    #[test]
    fn latch_and_queue_size_are_other_words_for_it() {
        let of = |qos, latch, size| {
            let Offer { qos, latch } = offered(RosVersion::One, qos, latch, size);
            (qos.durability, qos.depth, latch)
        };
        let (old, new) = (Durability::TransientLocal, Durability::Volatile);
        assert_eq!(of(None, false, None), (new, DEFAULT_QUEUE, false));
        assert_eq!(of(None, true, Some(0)), (old, DEFAULT_QUEUE, true));
        assert_eq!(of(None, true, Some(7)), (old, 7, true));
        assert_eq!(of(None, false, Some(u64::MAX)), (new, MOST_QUEUED, false));
        let kept = rosbridge::Qos {
            durability: Some(rosbridge::Durability::TransientLocal),
            depth: Some(1),
            ..rosbridge::Qos::default()
        };
        assert_eq!(of(said(kept), false, Some(7)), (old, 1, true));
        let fleeting = rosbridge::Qos {
            history: Some(History::KeepAll),
            durability: Some(rosbridge::Durability::Volatile),
            ..kept
        };
        assert_eq!(of(said(fleeting), true, None), (new, MOST_QUEUED, false));
        let best = rosbridge::Qos {
            durability: Some(rosbridge::Durability::BestAvailable),
            ..kept
        };
        assert_eq!(of(said(best), true, None), (old, 1, true));
        // In ROS 2 newcomers are given as many as are kept.
        let two = |latch, size| offered(RosVersion::Two, None, latch, size).qos.depth;
        assert_eq!((two(true, Some(7)), two(false, Some(7))), (1, 7));
    }

    #[test]
    fn what_is_said_of_time_is_offered_in_ros_2_and_told_to_mean_nothing_elsewhere() {
        let long = Duration::from_millis(100);
        let timed = rosbridge::Qos {
            deadline: Some(Period::Of(long)),
            lifespan: Some(Period::Infinite),
            liveliness: Some(rosbridge::Liveliness::ManualByTopic),
            ..rosbridge::Qos::default()
        };
        let of = |version| offered(version, said(timed), false, None).qos;
        assert_eq!(of(RosVersion::One), Qos::keep_last(DEFAULT_QUEUE));
        let two = of(RosVersion::Two);
        assert_eq!((two.deadline, two.lifespan), (Some(long), None));
        assert_eq!(two.liveliness, Liveliness::ManualByTopic);
        assert_eq!(unheard(RosVersion::Two, &timed, false), None);
        assert_eq!(
            unheard(RosVersion::One, &timed, false).unwrap(),
            "\"qos.deadline\", \"qos.lifespan\", \"qos.liveliness\" left out: this servant speaks ROS 1, which has no such policies"
        );
        let told = unheard(RosVersion::Two, &timed, true).unwrap();
        assert!(told.ends_with("publishers are heard whatever they offer of that"));
        let silent = rosbridge::Qos::default();
        assert_eq!(unheard(RosVersion::One, &silent, true), None);
        assert_eq!(asked(said(timed), 256), all_there_is(256));
    }
}
