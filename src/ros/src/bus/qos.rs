//! Quality of service, in the words of DDS and ROS 2.

use std::time::Duration;

/// Whether messages may be lost on the way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Reliability {
    /// Sent again until they have come.
    #[default]
    Reliable,
    /// Sent once. ROS 1 sends reliably all the same.
    BestEffort,
}

/// What newcomers among the subscribers are given.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Durability {
    /// What is published from then on.
    #[default]
    Volatile,
    /// Also what each publisher published last: what ROS 1 calls latching.
    TransientLocal,
}

/// Who says that a publisher is alive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Liveliness {
    /// ROS, for as long as its node is there.
    #[default]
    Automatic,
    /// What it publishes.
    ManualByTopic,
}

/// How one end of a topic treats messages. A subscription's is a wish: publishers that offer less are heard, too, and those of
/// ROS 1 give all newcomers what they have latched. What is said of time is an offer of publishers alone, and none of ROS 1's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Qos {
    /// Whether messages may be lost on the way.
    pub reliability: Reliability,
    /// What newcomers are given.
    pub durability: Durability,
    /// Messages kept for a receiver that is busy (0 counts as 1); the oldest is dropped, and counted, beyond.
    pub depth: usize,
    /// The longest time between two messages; none where that is not said.
    pub deadline: Option<Duration>,
    /// After so long a message is of no use; none where it always is.
    pub lifespan: Option<Duration>,
    /// Who says that the publisher is alive.
    pub liveliness: Liveliness,
    /// Within which time; none where that is not said.
    pub lease: Option<Duration>,
}

impl Qos {
    /// Reliable and volatile.
    pub const fn keep_last(depth: usize) -> Self {
        Self {
            reliability: Reliability::Reliable,
            durability: Durability::Volatile,
            depth,
            deadline: None,
            lifespan: None,
            liveliness: Liveliness::Automatic,
            lease: None,
        }
    }

    /// The same; transient-local if `latching`.
    pub const fn latching(mut self, latching: bool) -> Self {
        self.durability = if latching {
            Durability::TransientLocal
        } else {
            Durability::Volatile
        };
        self
    }

    /// Whether newcomers are given the last message.
    pub fn is_latching(&self) -> bool {
        self.durability == Durability::TransientLocal
    }
}
