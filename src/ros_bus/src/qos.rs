//! Quality of service, in the terms of DDS and ROS 2.

use std::time::Duration;

/// Delivery guarantee.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum QosReliability {
    /// Messages are resent until they have arrived.
    #[default]
    Reliable,
    /// Messages are sent once. ROS 1 sends reliably all the same.
    BestEffort,
}

/// Messages kept for late subscribers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum QosDurability {
    /// None: subscribers get what is published from then on.
    #[default]
    Volatile,
    /// The last message of each publisher; ROS 1 calls it latching.
    TransientLocal,
}

/// Way in which a publisher asserts its liveliness.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum QosLiveliness {
    /// ROS asserts it for as long as the node exists.
    #[default]
    Automatic,
    /// The publisher asserts it by publishing.
    ManualByTopic,
}

/// Quality of service of an endpoint. For a subscription it is a preference: publishers that offer less are matched as
/// well, and those of ROS 1 give late subscribers whatever they have latched. The fields that concern time apply to
/// publishers of ROS 2 only.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct QosProfile {
    /// Delivery guarantee.
    pub reliability: QosReliability,
    /// Messages kept for late subscribers.
    pub durability: QosDurability,
    /// Queue depth for a slow receiver (0 counts as 1); beyond it the oldest message is dropped and counted.
    pub depth: usize,
    /// Maximum time between two messages; `None` if unspecified.
    pub deadline: Option<Duration>,
    /// Time after which a message is obsolete; `None` if it never is.
    pub lifespan: Option<Duration>,
    /// Way in which the publisher asserts its liveliness.
    pub liveliness: QosLiveliness,
    /// Liveliness lease duration; `None` if unspecified.
    pub lease: Option<Duration>,
}

impl QosProfile {
    /// Creates a reliable and volatile profile.
    pub const fn keep_last(depth: usize) -> Self {
        Self {
            reliability: QosReliability::Reliable,
            durability: QosDurability::Volatile,
            depth,
            deadline: None,
            lifespan: None,
            liveliness: QosLiveliness::Automatic,
            lease: None,
        }
    }

    /// Returns the profile, made transient-local if `latching` and volatile otherwise.
    pub const fn latching(mut self, latching: bool) -> Self {
        self.durability = if latching { QosDurability::TransientLocal } else { QosDurability::Volatile };
        self
    }

    /// Returns true if late subscribers are given the last message.
    pub fn is_latching(&self) -> bool {
        self.durability == QosDurability::TransientLocal
    }

    /// Merges the profiles of two endpoints of one topic: publishers offer the stronger of both, subscribers request
    /// the weaker.
    pub fn merge(self, other: Self, publishes: bool) -> Self {
        let reliable = [self, other].map(|it| it.reliability == QosReliability::Reliable);
        let latching = [self, other].map(|it| it.is_latching());
        let both = |of: [bool; 2]| {
            if publishes { of[0] || of[1] } else { of[0] && of[1] }
        };
        let joined = Self {
            reliability: if both(reliable) { QosReliability::Reliable } else { QosReliability::BestEffort },
            depth: self.depth.max(other.depth),
            ..self
        };
        joined.latching(both(latching))
    }
}
