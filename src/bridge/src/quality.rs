//! Conversion of the quality of service requested by clients to that of the bus.

use std::time::Duration;

use ros::bus::{QosDurability, QosLiveliness, QosProfile, QosReliability, RosVersion};
use rosbridge::{HistoryPolicy, Period, Subscribe};

/// Default number of messages queued for a slow node.
const DEFAULT_QUEUE: usize = 100;
/// Maximum number of messages queued for a slow node.
const MAX_QUEUE: usize = 1000;

/// Quality of service offered by a client's publications.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PublisherOffer {
    /// Quality of service towards nodes.
    pub(crate) qos: QosProfile,
    /// Latching: new clients receive the last message.
    pub(crate) latch: bool,
}

/// Quality of service for subscriptions that do not specify any: as much as publishers offer, including the messages
/// they keep. `depth` is the number of messages that the bus queues for the bridge.
pub(crate) const fn default_subscription_qos(depth: usize) -> QosProfile {
    QosProfile::keep_last(depth).latching(true)
}

/// Returns the quality of service that a client's subscription requests from publishers. The number of messages queued
/// for the client itself is [separate](queue_length).
pub(crate) fn subscription_qos(qos: Option<rosbridge::QosRequest>, depth: usize) -> QosProfile {
    let all = default_subscription_qos(depth);
    let Some(qos) = qos else { return all };
    QosProfile {
        reliability: match qos.reliability {
            Some(rosbridge::ReliabilityPolicy::BestEffort) => QosReliability::BestEffort,
            _ => all.reliability,
        },
        durability: match qos.durability {
            Some(rosbridge::DurabilityPolicy::Volatile) => QosDurability::Volatile,
            _ => all.durability,
        },
        ..all
    }
}

/// Returns the quality of service that satisfies all of a client's subscriptions to a topic.
pub(crate) fn merge_qos<'q>(all: impl Iterator<Item = &'q QosProfile>) -> Option<QosProfile> {
    all.copied().reduce(|one, other| QosProfile {
        reliability: match one.reliability {
            QosReliability::Reliable => QosReliability::Reliable,
            QosReliability::BestEffort => other.reliability,
        },
        durability: match one.durability {
            QosDurability::TransientLocal => QosDurability::TransientLocal,
            QosDurability::Volatile => other.durability,
        },
        ..one
    })
}

/// Describes the policies of a client that have no effect: for ROS 1, or for a subscription, which requests nothing
/// about the timing of publishers.
pub(crate) fn ignored_policies(version: RosVersion, qos: &rosbridge::QosRequest, subscribes: bool) -> Option<String> {
    if version == RosVersion::Two && !subscribes {
        return None;
    }
    let said = [
        ("qos.deadline", qos.deadline.is_some()),
        ("qos.lifespan", qos.lifespan.is_some()),
        ("qos.liveliness", qos.liveliness.is_some()),
        ("qos.liveliness_lease_duration", qos.liveliness_lease_duration.is_some()),
    ];
    let names = said.iter().filter(|(_, is_said)| *is_said);
    let names: Vec<String> = names.map(|(name, _)| format!("{name:?}")).collect();
    if names.is_empty() {
        return None;
    }
    let why = match version {
        RosVersion::One => "this servant speaks ROS 1, which has no such policies",
        RosVersion::Two => "subscriptions here accept whatever publishers offer there",
    };
    Some(format!("{} ignored: {why}", names.join(", ")))
}

/// Returns the duration that a client offers; `None` for any.
fn offered_period(period: Option<Period>) -> Option<Duration> {
    match period {
        Some(Period::Of(long)) => Some(long),
        Some(Period::Infinite | Period::BestAvailable) | None => None,
    }
}

/// Returns the number of messages queued for a client with this subscription; 0 if unspecified.
pub(crate) fn queue_length(op: &Subscribe<'_>) -> usize {
    match op.qos {
        Some(qos) if op.queue_length == 0 => match qos.history {
            Some(HistoryPolicy::KeepAll) => usize::MAX,
            _ => qos.depth.unwrap_or(0),
        },
        _ => op.queue_length,
    }
}

/// Returns the quality of service of a client's publications: by `qos` if given, otherwise by rosbridge's older fields.
pub(crate) fn publication_offer(
    version: RosVersion,
    qos: Option<rosbridge::QosRequest>,
    latch: bool,
    queue_size: Option<u64>,
) -> PublisherOffer {
    let qos = qos.unwrap_or_default();
    let latch = match qos.durability {
        Some(rosbridge::DurabilityPolicy::TransientLocal) => true,
        Some(rosbridge::DurabilityPolicy::Volatile) => false,
        Some(rosbridge::DurabilityPolicy::BestAvailable) | None => latch,
    };
    let said = queue_size.filter(|size| *size > 0);
    let depth = match (qos.history, qos.depth) {
        (Some(HistoryPolicy::KeepAll), _) => MAX_QUEUE,
        (_, Some(depth)) => depth,
        // This many are sent to new subscribers: of latched messages the last one.
        (_, None) if latch && version == RosVersion::Two => 1,
        (_, None) => said.map_or(DEFAULT_QUEUE, |size| usize::try_from(size).unwrap_or(usize::MAX)),
    };
    let reliability = match qos.reliability {
        Some(rosbridge::ReliabilityPolicy::BestEffort) => QosReliability::BestEffort,
        _ => QosReliability::Reliable,
    };
    let liveliness = match qos.liveliness {
        Some(rosbridge::LivelinessPolicy::ManualByTopic) => QosLiveliness::ManualByTopic,
        _ => QosLiveliness::Automatic,
    };
    let basic = QosProfile { reliability, ..QosProfile::keep_last(depth.min(MAX_QUEUE)).latching(latch) };
    let qos = match version {
        RosVersion::One => basic,
        RosVersion::Two => QosProfile {
            deadline: offered_period(qos.deadline),
            lifespan: offered_period(qos.lifespan),
            liveliness,
            lease: offered_period(qos.liveliness_lease_duration),
            ..basic
        },
    };
    PublisherOffer { qos, latch }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use rosbridge::Compression;

    use super::*;

    fn some_qos(qos: rosbridge::QosRequest) -> Option<rosbridge::QosRequest> {
        Some(qos)
    }

    #[test]
    fn who_does_not_say_what_it_wants_is_given_all_there_is() {
        let all = default_subscription_qos(256);
        assert!(all.is_latching());
        assert_eq!(subscription_qos(None, 256), all);
        assert_eq!(subscription_qos(some_qos(rosbridge::QosRequest::default()), 256), all);
        let deep = rosbridge::QosRequest {
            depth: Some(5),
            reliability: Some(rosbridge::ReliabilityPolicy::BestAvailable),
            durability: Some(rosbridge::DurabilityPolicy::TransientLocal),
            ..rosbridge::QosRequest::default()
        };
        assert_eq!(subscription_qos(some_qos(deep), 256), all, "its depth is its own queue's");
        let least = rosbridge::QosRequest {
            reliability: Some(rosbridge::ReliabilityPolicy::BestEffort),
            durability: Some(rosbridge::DurabilityPolicy::Volatile),
            ..rosbridge::QosRequest::default()
        };
        let least = subscription_qos(some_qos(least), 256);
        assert_eq!(least.reliability, QosReliability::BestEffort);
        assert_eq!(least.durability, QosDurability::Volatile);
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
        let depth = |depth| rosbridge::QosRequest { depth: Some(depth), ..rosbridge::QosRequest::default() };
        let all = rosbridge::QosRequest { history: Some(HistoryPolicy::KeepAll), ..depth(5) };
        for (length, qos, expected) in [
            (0, None, 0),
            (3, None, 3),
            (0, some_qos(depth(5)), 5),
            (3, some_qos(depth(5)), 3),
            (0, some_qos(rosbridge::QosRequest::default()), 0),
            (0, some_qos(all), usize::MAX),
        ] {
            assert_eq!(queue_length(&subscribe(length, qos)), expected);
        }
    }

    #[test]
    fn latch_and_queue_size_are_other_words_for_it() {
        let of = |qos, latch, size| {
            let PublisherOffer { qos, latch } = publication_offer(RosVersion::One, qos, latch, size);
            (qos.durability, qos.depth, latch)
        };
        let (old, new) = (QosDurability::TransientLocal, QosDurability::Volatile);
        assert_eq!(of(None, false, None), (new, DEFAULT_QUEUE, false));
        assert_eq!(of(None, true, Some(0)), (old, DEFAULT_QUEUE, true));
        assert_eq!(of(None, true, Some(7)), (old, 7, true));
        assert_eq!(of(None, false, Some(u64::MAX)), (new, MAX_QUEUE, false));
        let kept = rosbridge::QosRequest {
            durability: Some(rosbridge::DurabilityPolicy::TransientLocal),
            depth: Some(1),
            ..rosbridge::QosRequest::default()
        };
        assert_eq!(of(some_qos(kept), false, Some(7)), (old, 1, true));
        let fleeting = rosbridge::QosRequest {
            history: Some(HistoryPolicy::KeepAll),
            durability: Some(rosbridge::DurabilityPolicy::Volatile),
            ..kept
        };
        assert_eq!(of(some_qos(fleeting), true, None), (new, MAX_QUEUE, false));
        let best = rosbridge::QosRequest { durability: Some(rosbridge::DurabilityPolicy::BestAvailable), ..kept };
        assert_eq!(of(some_qos(best), true, None), (old, 1, true));
        // In ROS 2 new subscribers receive as many messages as are kept.
        let two = |latch, size| publication_offer(RosVersion::Two, None, latch, size).qos.depth;
        assert_eq!((two(true, Some(7)), two(false, Some(7))), (1, 7));
    }

    #[test]
    fn what_is_said_of_time_is_offered_in_ros_2_and_told_to_mean_nothing_elsewhere() {
        let long = Duration::from_millis(100);
        let timed = rosbridge::QosRequest {
            deadline: Some(Period::Of(long)),
            lifespan: Some(Period::Infinite),
            liveliness: Some(rosbridge::LivelinessPolicy::ManualByTopic),
            ..rosbridge::QosRequest::default()
        };
        let of = |version| publication_offer(version, some_qos(timed), false, None).qos;
        assert_eq!(of(RosVersion::One), QosProfile::keep_last(DEFAULT_QUEUE));
        let two = of(RosVersion::Two);
        assert_eq!((two.deadline, two.lifespan), (Some(long), None));
        assert_eq!(two.liveliness, QosLiveliness::ManualByTopic);
        assert_eq!(ignored_policies(RosVersion::Two, &timed, false), None);
        assert_eq!(
            ignored_policies(RosVersion::One, &timed, false).unwrap(),
            "\"qos.deadline\", \"qos.lifespan\", \"qos.liveliness\" ignored: this servant speaks ROS 1, which has no \
             such policies"
        );
        let told = ignored_policies(RosVersion::Two, &timed, true).unwrap();
        assert!(told.ends_with("subscriptions here accept whatever publishers offer there"));
        let silent = rosbridge::QosRequest::default();
        assert_eq!(ignored_policies(RosVersion::One, &silent, true), None);
        assert_eq!(subscription_qos(some_qos(timed), 256), default_subscription_qos(256));
    }
}
