//! Quality of service of topics, in the words of ROS 2's tools.

use std::fmt;
use std::time::Duration;

use ros::bus;
use serde::{Deserialize, Serialize};

/// What publishers of a topic offer, or its subscribers ask for. How many messages they keep is not told to others. Times
/// are seconds; none where that is not said.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Qos {
    /// Whether messages may be lost on the way.
    pub reliability: Reliability,
    /// What newcomers among the subscribers are given.
    pub durability: Durability,
    /// The longest time between two messages.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub deadline: Option<f64>,
    /// After so long a message is of no use.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lifespan: Option<f64>,
    /// Who says that a publisher is alive.
    pub liveliness: Liveliness,
    /// Within which time.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lease: Option<f64>,
}

/// Whether messages may be lost on the way; what comes later is more.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Reliability {
    /// Sent once.
    BestEffort,
    /// Sent again until they have come.
    #[default]
    Reliable,
}

/// What newcomers are given; what comes later is more.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Durability {
    /// What is published from then on.
    #[default]
    Volatile,
    /// Also what was published last.
    TransientLocal,
}

/// Who says that a publisher is alive; what comes later is more.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Liveliness {
    /// ROS, for as long as its node is there.
    #[default]
    Automatic,
    /// What it publishes.
    ManualByTopic,
}

impl Qos {
    /// What both offer: whoever asks for that hears either of them.
    pub fn least(self, other: Self) -> Self {
        Self {
            reliability: self.reliability.min(other.reliability),
            durability: self.durability.min(other.durability),
            deadline: longest(self.deadline, other.deadline),
            lifespan: shortest(self.lifespan, other.lifespan),
            liveliness: self.liveliness.min(other.liveliness),
            lease: longest(self.lease, other.lease),
        }
    }

    /// What both ask for: whoever offers that is heard by either of them.
    pub fn most(self, other: Self) -> Self {
        Self {
            reliability: self.reliability.max(other.reliability),
            durability: self.durability.max(other.durability),
            deadline: shortest(self.deadline, other.deadline),
            lifespan: longest(self.lifespan, other.lifespan),
            liveliness: self.liveliness.max(other.liveliness),
            lease: shortest(self.lease, other.lease),
        }
    }

    /// For an end of ours that keeps so many messages.
    pub fn on_bus(&self, depth: usize) -> bus::Qos {
        let time = |seconds: Option<f64>| Duration::try_from_secs_f64(seconds?).ok();
        bus::Qos {
            reliability: match self.reliability {
                Reliability::Reliable => bus::Reliability::Reliable,
                Reliability::BestEffort => bus::Reliability::BestEffort,
            },
            durability: match self.durability {
                Durability::Volatile => bus::Durability::Volatile,
                Durability::TransientLocal => bus::Durability::TransientLocal,
            },
            depth,
            deadline: time(self.deadline),
            lifespan: time(self.lifespan),
            liveliness: match self.liveliness {
                Liveliness::Automatic => bus::Liveliness::Automatic,
                Liveliness::ManualByTopic => bus::Liveliness::ManualByTopic,
            },
            lease: time(self.lease),
        }
    }
}

impl From<&bus::Qos> for Qos {
    fn from(of: &bus::Qos) -> Self {
        let seconds = |time: Option<Duration>| time.map(|time| time.as_secs_f64());
        Self {
            reliability: match of.reliability {
                bus::Reliability::Reliable => Reliability::Reliable,
                bus::Reliability::BestEffort => Reliability::BestEffort,
            },
            durability: match of.durability {
                bus::Durability::Volatile => Durability::Volatile,
                bus::Durability::TransientLocal => Durability::TransientLocal,
            },
            deadline: seconds(of.deadline),
            lifespan: seconds(of.lifespan),
            liveliness: match of.liveliness {
                bus::Liveliness::Automatic => Liveliness::Automatic,
                bus::Liveliness::ManualByTopic => Liveliness::ManualByTopic,
            },
            lease: seconds(of.lease),
        }
    }
}

/// For people; what is as usual is left out beside the first two.
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

/// None is for ever.
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
            strict.least(loose),
            Qos {
                reliability: Reliability::BestEffort,
                ..Qos::default()
            }
        );
        assert_eq!(
            strict.most(loose),
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
        assert_eq!(Qos::from(&qos.on_bus(7)), qos);
        let impossible = Qos {
            deadline: Some(f64::INFINITY),
            ..qos
        };
        assert_eq!(impossible.on_bus(7).deadline, None);
        assert_eq!(
            qos.to_string(),
            "best_effort, volatile, liveliness manual_by_topic, deadline 0.5 s, lifespan 3 s, liveliness lease 1.25 s"
        );
        assert_eq!(Qos::default().to_string(), "reliable, volatile");
    }
}
