//! The SLA of a robot, as written in its parameters, its launch file or its configuration.

#[cfg(test)]
mod tests;
mod written;

use std::collections::BTreeMap;
use std::time::Duration;

use serde::{Deserialize, Deserializer, Serialize};

use crate::pair::TopicPair;
use crate::sla_error::SlaError;
use written::RawSla;

/// Response-time goals of a node and the measures to meet them. Times are written in seconds (`0.3`) or with a unit
/// (`"300ms"`).
///
/// ```toml
/// t_desire = 0.1             # desirable response time of the cloud
/// t_max = 0.3                # maximal acceptable response time
/// threshold = 4.0            # Q_t: below it the local original is wanted
/// initial = 8.0              # initial Q (default: 2·Q_t)
/// cap = 16.0                 # upper bound of Q (default: 4·Q_t; inf for the algorithm as published)
/// unreached = 3              # seconds without a first contact to the cloud until the local original takes over
/// mode = "stateless"         # or "stateful": the local original only while the link is down
/// local = "cold"             # or "warm", or "none"
/// answers = ["/image -> /people_detect/found"]
/// safe_stop = { topic = "/cmd_vel", type = "geometry_msgs/Twist", message = {} }
/// ```
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct QosSla {
    /// T_desire.
    #[serde(serialize_with = "seconds")]
    pub t_desire: Duration,
    /// T_max.
    #[serde(serialize_with = "seconds")]
    pub t_max: Duration,
    /// Threshold Q_t.
    pub threshold: f64,
    /// Initial Q.
    pub initial: f64,
    /// Upper bound of Q (exclusive); may be infinite.
    pub cap: f64,
    /// For SLAs with a response time: time without a first contact to the cloud after which the local original takes
    /// over. Nothing can be asked before that contact, because the interface of the node is not known yet.
    #[serde(serialize_with = "seconds")]
    pub unreached: Duration,
    /// Dependence between requests: stateless or stateful.
    pub mode: Mode,
    /// Policy for the local original.
    pub local: LocalPolicy,
    /// With [`LocalPolicy::Warm`]: when its process is started.
    pub warm: WarmStart,
    /// The quantity that is compared with T_desire and T_max.
    pub measure: Measure,
    /// Pairs that override the automatic detection; empty means that only calls and goals are requests.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub answers: Option<Vec<TopicPair>>,
    /// Message to publish when no side answers in time.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub safe_stop: Option<SafeStop>,
    /// Times of single services, actions and inputs that differ, by name.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub requests: BTreeMap<String, Times>,
}

/// T_desire and T_max of one kind of request.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Times {
    /// T_desire.
    #[serde(serialize_with = "seconds")]
    pub t_desire: Duration,
    /// T_max.
    #[serde(serialize_with = "seconds")]
    pub t_max: Duration,
}

/// Dependence between requests.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// Requests are independent: both sides may be asked, and either may answer.
    #[default]
    Stateless,
    /// Answers depend on earlier requests: one side is asked at a time, the local original only while the link is down.
    Stateful,
}

/// Policy for the local original.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LocalPolicy {
    /// The process is started and stopped by the algorithm.
    #[default]
    Cold,
    /// The process runs before it is needed, and the algorithm only controls whether it is fed.
    Warm,
    /// No local original is installed or used.
    None,
}

/// When a warm local original is started.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum WarmStart {
    /// It runs as long as the node.
    #[default]
    AtOnce,
    /// It runs from the first late request until Q is full again.
    FirstSign,
}

/// The quantity T that is compared with T_desire and T_max.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Measure {
    /// Response time of requests.
    #[default]
    Rrt,
    /// Mean interval of the last frames of an output; T_desire and T_max are the inverse rates.
    FramesPerSecond {
        /// Output topic; empty for the one that answers the first detected request.
        output: String,
        /// Number of frames to average over.
        over: usize,
    },
    /// Age that an output has reached when the next one arrives, counted from its `header.stamp` if it has one.
    Age {
        /// Output topic; empty for the one that answers the first detected request.
        output: String,
    },
    /// No response time: the local original takes over while the link is down.
    Link {
        /// Time for which the link must have been down.
        #[serde(serialize_with = "seconds")]
        after: Duration,
    },
}

/// The message that stops the robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SafeStop {
    /// Absolute name of the topic.
    pub topic: String,
    /// Message type, as `package/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Fields of the message; omitted ones are zero.
    #[serde(default)]
    pub message: serde_json::Map<String, serde_json::Value>,
}

impl QosSla {
    /// Parses and checks an SLA. `from` is any serde source: a table of a TOML file, ROS parameters as JSON.
    ///
    /// # Errors
    /// Returns the first field that is missing, unknown, of the wrong type or out of range.
    pub fn parse<'de, D: Deserializer<'de>>(from: D) -> Result<Self, SlaError> {
        let written: RawSla = serde_path_to_error::deserialize(from).map_err(|error| {
            let path = error.path().to_string();
            SlaError {
                field: if path == "." { "the SLA".into() } else { path },
                // Some formats append the position in the file on lines of its own.
                reason: error.into_inner().to_string().trim().replace('\n', " "),
            }
        })?;
        written.check()
    }

    /// Returns true if the SLA has no response time and only the link decides about the local original.
    pub fn is_link_based(&self) -> bool {
        matches!(self.measure, Measure::Link { .. })
    }

    /// Returns the times of one service, action or input.
    pub fn times(&self, name: &str) -> Times {
        self.requests.get(name).copied().unwrap_or(Times { t_desire: self.t_desire, t_max: self.t_max })
    }
}

impl<'de> Deserialize<'de> for QosSla {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        RawSla::deserialize(from)?.check().map_err(serde::de::Error::custom)
    }
}

fn seconds<S: serde::Serializer>(time: &Duration, out: S) -> Result<S::Ok, S::Error> {
    out.serialize_f64(time.as_secs_f64())
}
