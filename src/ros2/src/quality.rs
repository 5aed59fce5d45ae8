//! Quality of service: conversion between the bus and DDS.

use ros_bus::{QosDurability, QosLiveliness, QosProfile, QosReliability};
use rtps::{DurabilityKind, EndpointData, EndpointQos, HistoryKind, LivelinessKind, Mismatch, ReliabilityKind};

/// Depth shown for an endpoint that keeps all samples.
const DEPTH: usize = 10;

/// The policies that determine which publishers a subscription matches; it requests nothing in any other policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct Quality {
    pub(super) reliability: ReliabilityKind,
    pub(super) durability: DurabilityKind,
}

impl Quality {
    /// Returns the requested quality.
    pub(super) fn from_qos(qos: &QosProfile) -> Self {
        Self {
            reliability: match qos.reliability {
                QosReliability::Reliable => ReliabilityKind::Reliable,
                QosReliability::BestEffort => ReliabilityKind::BestEffort,
            },
            durability: match qos.durability {
                QosDurability::Volatile => DurabilityKind::Volatile,
                QosDurability::TransientLocal => DurabilityKind::TransientLocal,
            },
        }
    }

    /// Returns the part of this quality that a writer offers.
    pub(super) fn at_most(self, offered: &EndpointQos) -> Self {
        Self {
            reliability: self.reliability.min(offered.reliability),
            durability: self.durability.min(offered.durability),
        }
    }
}

/// Returns the QoS of a writer of ours, including the policies that concern time.
pub(super) fn writer_qos(qos: &QosProfile) -> EndpointQos {
    EndpointQos {
        deadline: qos.deadline,
        lifespan: qos.lifespan,
        liveliness: match qos.liveliness {
            QosLiveliness::Automatic => LivelinessKind::Automatic,
            QosLiveliness::ManualByTopic => LivelinessKind::ManualByTopic,
        },
        lease: qos.lease,
        ..reader_qos(Quality::from_qos(qos), qos.depth)
    }
}

/// Returns the QoS of a reader of ours, which requests nothing else.
pub(super) fn reader_qos(quality: Quality, depth: usize) -> EndpointQos {
    EndpointQos {
        reliability: quality.reliability,
        durability: quality.durability,
        history: HistoryKind::KeepLast(u32::try_from(depth.max(1)).unwrap_or(u32::MAX)),
        ..EndpointQos::default()
    }
}

/// Returns the QoS announced by an endpoint of another node.
pub(super) fn from_endpoint(qos: &EndpointQos) -> QosProfile {
    QosProfile {
        reliability: match qos.reliability {
            ReliabilityKind::Reliable => QosReliability::Reliable,
            ReliabilityKind::BestEffort => QosReliability::BestEffort,
        },
        durability: match qos.durability {
            DurabilityKind::Volatile => QosDurability::Volatile,
            _ => QosDurability::TransientLocal,
        },
        depth: match qos.history {
            HistoryKind::KeepLast(depth) => usize::try_from(depth).unwrap_or(usize::MAX).max(1),
            HistoryKind::KeepAll => DEPTH,
        },
        deadline: qos.deadline,
        lifespan: qos.lifespan,
        liveliness: match qos.liveliness {
            LivelinessKind::ManualByTopic => QosLiveliness::ManualByTopic,
            _ => QosLiveliness::Automatic,
        },
        lease: qos.lease,
    }
}

/// Describes why a writer and a reader do not match, with both profiles.
pub(super) fn mismatch_text(why: &[Mismatch], offered: &EndpointQos, requested: &EndpointQos) -> String {
    let reasons: Vec<String> = why.iter().map(Mismatch::to_string).collect();
    format!("{} (publisher: {}; subscriber: {})", reasons.join("; "), profile(offered), profile(requested))
}

/// Describes a profile in the terms of ROS 2's tools; infinite durations are left out.
fn profile(qos: &EndpointQos) -> String {
    let mut words = vec![qos.reliability.to_string(), qos.durability.to_string()];
    let lease = qos.lease.is_some().then(|| format!("liveliness {}", qos.liveliness));
    words.extend(lease);
    let times = [("deadline", qos.deadline), ("lifespan", qos.lifespan), ("liveliness lease", qos.lease)];
    words.extend(times.iter().filter_map(|(what, time)| time.map(|time| format!("{what} {} s", time.as_secs_f64()))));
    words.join(", ")
}

/// Returns true if a writer keeps its last messages for late subscribers.
pub(super) fn is_latching(endpoint: &EndpointData) -> bool {
    endpoint.qos.durability >= DurabilityKind::TransientLocal
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_wish_is_granted_as_far_as_it_is_offered() {
        let wish = Quality::from_qos(&QosProfile::keep_last(5).latching(true));
        let offered = EndpointQos {
            reliability: ReliabilityKind::BestEffort,
            durability: DurabilityKind::Persistent,
            ..EndpointQos::default()
        };
        let granted = wish.at_most(&offered);
        assert_eq!(
            (granted.reliability, granted.durability),
            (ReliabilityKind::BestEffort, DurabilityKind::TransientLocal)
        );
        assert_eq!(offered.mismatches(&reader_qos(granted, 5)), []);
        assert_eq!(reader_qos(wish, 0).history, HistoryKind::KeepLast(1));
    }

    #[test]
    fn a_refusal_says_both_profiles() {
        let offered = EndpointQos { reliability: ReliabilityKind::BestEffort, ..EndpointQos::default() };
        let requested = EndpointQos { deadline: Some(Duration::from_millis(100)), ..EndpointQos::default() };
        let why = mismatch_text(&offered.mismatches(&requested), &offered, &requested);
        assert_eq!(
            why,
            "reliability: the publisher offers best_effort, the subscriber asks for reliable; \
             deadline: the publisher offers infinite, the subscriber asks for 0.1 s \
             (publisher: best_effort, volatile; subscriber: reliable, volatile, deadline 0.1 s)"
        );
    }
}
