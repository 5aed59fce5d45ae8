//! Quality of service of topics, in the terms of ROS 2's tools.

use std::fmt;
use std::time::Duration;

use ros::bus;
use serde::{Deserialize, Serialize};

/// QoS offered by the publishers of a topic or requested by its subscribers. The history depth is not announced to
/// others. Times are in seconds; absent if unspecified.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Qos {
    /// Reliability policy.
    pub reliability: Reliability,
    /// Durability policy.
    pub durability: Durability,
    /// Maximum time between two messages.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub deadline: Option<f64>,
    /// Time after which a message expires.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lifespan: Option<f64>,
    /// Liveliness policy.
    pub liveliness: Liveliness,
    /// Liveliness lease duration.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lease: Option<f64>,
}

/// Reliability policy, in ascending order of strictness.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Reliability {
    /// Messages may be lost.
    BestEffort,
    /// Lost messages are retransmitted.
    #[default]
    Reliable,
}

/// Durability policy, in ascending order of strictness.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Durability {
    /// New subscribers get only messages published after they subscribe.
    #[default]
    Volatile,
    /// New subscribers also get the latest messages published earlier.
    TransientLocal,
}

/// Liveliness policy, in ascending order of strictness.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Liveliness {
    /// The publisher is alive as long as its node is.
    #[default]
    Automatic,
    /// The publisher is alive as long as it publishes.
    ManualByTopic,
}

impl Qos {
    /// Returns the QoS that both offer: a subscriber that requests it receives from either of them.
    pub fn common_offer(self, other: Self) -> Self {
        Self {
            reliability: self.reliability.min(other.reliability),
            durability: self.durability.min(other.durability),
            deadline: longest(self.deadline, other.deadline),
            lifespan: shortest(self.lifespan, other.lifespan),
            liveliness: self.liveliness.min(other.liveliness),
            lease: longest(self.lease, other.lease),
        }
    }

    /// Returns the QoS that satisfies both requests: a publisher that offers it is received by either of them.
    pub fn common_request(self, other: Self) -> Self {
        Self {
            reliability: self.reliability.max(other.reliability),
            durability: self.durability.max(other.durability),
            deadline: shortest(self.deadline, other.deadline),
            lifespan: longest(self.lifespan, other.lifespan),
            liveliness: self.liveliness.max(other.liveliness),
            lease: shortest(self.lease, other.lease),
        }
    }

    /// Converts to the QoS of an endpoint of ours with this history depth.
    pub fn to_bus_qos(&self, depth: usize) -> bus::QosProfile {
        let time = |seconds: Option<f64>| Duration::try_from_secs_f64(seconds?).ok();
        bus::QosProfile {
            reliability: match self.reliability {
                Reliability::Reliable => bus::QosReliability::Reliable,
                Reliability::BestEffort => bus::QosReliability::BestEffort,
            },
            durability: match self.durability {
                Durability::Volatile => bus::QosDurability::Volatile,
                Durability::TransientLocal => bus::QosDurability::TransientLocal,
            },
            depth,
            deadline: time(self.deadline),
            lifespan: time(self.lifespan),
            liveliness: match self.liveliness {
                Liveliness::Automatic => bus::QosLiveliness::Automatic,
                Liveliness::ManualByTopic => bus::QosLiveliness::ManualByTopic,
            },
            lease: time(self.lease),
        }
    }
}

impl From<&bus::QosProfile> for Qos {
    fn from(of: &bus::QosProfile) -> Self {
        let seconds = |time: Option<Duration>| time.map(|time| time.as_secs_f64());
        Self {
            reliability: match of.reliability {
                bus::QosReliability::Reliable => Reliability::Reliable,
                bus::QosReliability::BestEffort => Reliability::BestEffort,
            },
            durability: match of.durability {
                bus::QosDurability::Volatile => Durability::Volatile,
                bus::QosDurability::TransientLocal => Durability::TransientLocal,
            },
            deadline: seconds(of.deadline),
            lifespan: seconds(of.lifespan),
            liveliness: match of.liveliness {
                bus::QosLiveliness::Automatic => Liveliness::Automatic,
                bus::QosLiveliness::ManualByTopic => Liveliness::ManualByTopic,
            },
            lease: seconds(of.lease),
        }
    }
}

/// Writes a human-readable form; the policies after the first two only if they are not the default.
impl fmt::Display for Qos {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self.reliability {
            Reliability::Reliable => "reliable",
            Reliability::BestEffort => "best_effort",
        })?;
        f.write_str(match self.durability {
            Durability::Volatile => ", volatile",
            Durability::TransientLocal => ", transient_local",
        })?;
        if self.liveliness == Liveliness::ManualByTopic {
            f.write_str(", liveliness manual_by_topic")?;
        }
        let times = [
            ("deadline", self.deadline),
            ("lifespan", self.lifespan),
            ("liveliness lease", self.lease),
        ];
        for (what, seconds) in times {
            if let Some(seconds) = seconds {
                write!(f, ", {what} {seconds} s")?;
            }
        }
        Ok(())
    }
}

/// Returns the longer time; `None` means infinite.
fn longest(one: Option<f64>, other: Option<f64>) -> Option<f64> {
    Some(one?.max(other?))
}

fn shortest(one: Option<f64>, other: Option<f64>) -> Option<f64> {
    match (one, other) {
        (Some(one), Some(other)) => Some(one.min(other)),
        (one, other) => one.or(other),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ends_of_one_topic_have_in_common_what_suits_all_of_them() {
        let strict = Qos {
            durability: Durability::TransientLocal,
            deadline: Some(0.1),
            ..Qos::default()
        };
        let loose = Qos {
            reliability: Reliability::BestEffort,
            lease: Some(2.0),
            ..Qos::default()
        };
        assert_eq!(
            strict.common_offer(loose),
            Qos {
                reliability: Reliability::BestEffort,
                ..Qos::default()
            }
        );
        assert_eq!(
            strict.common_request(loose),
            Qos {
                lease: Some(2.0),
                ..strict
            }
        );
    }

    #[test]
    fn it_is_on_a_bus_what_it_was_there() {
        let qos = Qos {
            reliability: Reliability::BestEffort,
            liveliness: Liveliness::ManualByTopic,
            deadline: Some(0.5),
            lifespan: Some(3.0),
            lease: Some(1.25),
            ..Qos::default()
        };
        assert_eq!(Qos::from(&qos.to_bus_qos(7)), qos);
        let impossible = Qos {
            deadline: Some(f64::INFINITY),
            ..qos
        };
        assert_eq!(impossible.to_bus_qos(7).deadline, None);
        assert_eq!(
            qos.to_string(),
            "best_effort, volatile, liveliness manual_by_topic, deadline 0.5 s, lifespan 3 s, liveliness lease 1.25 s"
        );
        assert_eq!(Qos::default().to_string(), "reliable, volatile");
    }
}
