//! What the robot is promised, as written in its parameters, its launch file or its configuration.

#[cfg(test)]
mod tests;
mod written;

use std::collections::BTreeMap;
use std::time::Duration;

use serde::{Deserialize, Deserializer, Serialize};

use crate::pair::Pair;
use crate::sla_error::SlaError;
use written::Written;

/// The promise, and what is done to keep it. Times are written as seconds (`0.3`) or with a unit (`"300ms"`).
///
/// ```toml
/// t_desire = 0.1             # desirable response time of the cloud
/// t_max = 0.3                # maximal acceptable response time
/// threshold = 4.0            # Q_t: below it the local original is wanted
/// initial = 8.0              # Q at the beginning; 2·Q_t where it is not given
/// cap = 16.0                 # Q stays below it; 4·Q_t where it is not given, inf as the algorithm was published
/// unreached = 3              # without the cloud from the beginning: seconds after which the local original stands in
/// mode = "stateless"         # or "stateful": the local original only while the link is down
/// local = "cold"             # or "warm", or "none"
/// answers = ["/image -> /people_detect/found"]
/// safe_stop = { topic = "/cmd_vel", type = "geometry_msgs/Twist", message = {} }
/// ```
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Sla {
    /// T_desire.
    #[serde(serialize_with = "seconds")]
    pub t_desire: Duration,
    /// T_max.
    #[serde(serialize_with = "seconds")]
    pub t_max: Duration,
    /// Q_t.
    pub threshold: f64,
    /// Q at the beginning.
    pub initial: f64,
    /// Q stays below it; may be infinite.
    pub cap: f64,
    /// Where a time is promised: until the cloud is reached for the first time, the local original stands in after so long.
    /// Nothing can be asked then, because nobody knows yet what the node registers.
    #[serde(serialize_with = "seconds")]
    pub unreached: Duration,
    /// Whether requests depend on one another.
    pub mode: Mode,
    /// How the local original is kept.
    pub local: Local,
    /// With [`Local::Warm`], from when on its process runs.
    pub warm: Warm,
    /// What T is.
    pub measure: Measure,
    /// Overrides what is found automatically; empty means that nothing but calls and goals is a request.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub answers: Option<Vec<Pair>>,
    /// What is published when nobody answers in time.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub safe_stop: Option<SafeStop>,
    /// Other times for single services, actions and inputs, by name.
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

/// Whether requests depend on one another.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// Each stands alone: both sides may be asked, either may answer.
    #[default]
    Stateless,
    /// Answers depend on earlier requests: one side at a time, the local original only while the link is down.
    Stateful,
}

/// How the local original is kept.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Local {
    /// Its process is started and ended as the algorithm says.
    #[default]
    Cold,
    /// Its process runs before it is needed and is only fed as the algorithm says.
    Warm,
    /// There is none, or it is not to be used.
    None,
}

/// From when on a warm local original runs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Warm {
    /// As long as the node runs.
    #[default]
    AtOnce,
    /// From the first late request until Q is full again.
    FirstSign,
}

/// What T is.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Measure {
    /// The response time of requests.
    #[default]
    Rrt,
    /// The mean interval of the last frames of an output; T_desire and T_max are the inverse rates.
    FramesPerSecond {
        /// The output topic; empty: the one that answers the first request that is found.
        output: String,
        /// Frames over which the mean is taken.
        over: usize,
    },
    /// How old an output has become when the next one comes, counted from its `header.stamp` where it has one.
    Age {
        /// The output topic; empty: the one that answers the first request that is found.
        output: String,
    },
    /// Nothing, no time was promised: the local original stands in while the link is away.
    Link {
        /// For so long the link must have been away.
        #[serde(serialize_with = "seconds")]
        after: Duration,
    },
}

/// The message that brings the robot to rest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SafeStop {
    /// Absolute topic name.
    pub topic: String,
    /// `package/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Its fields; those not given are zero.
    #[serde(default)]
    pub message: serde_json::Map<String, serde_json::Value>,
}

impl Sla {
    /// Reads and checks an SLA. `from` is any serde source: a table of a TOML file, ROS parameters as JSON.
    ///
    /// # Errors
    /// The first field that is missing, unknown, of another type or out of range.
    pub fn parse<'de, D: Deserializer<'de>>(from: D) -> Result<Self, SlaError> {
        let written: Written = serde_path_to_error::deserialize(from).map_err(|error| {
            let path = error.path().to_string();
            SlaError {
                field: if path == "." { "the SLA".into() } else { path },
                // Some formats add the place in the file as lines of its own.
                reason: error.into_inner().to_string().trim().replace('\n', " "),
            }
        })?;
        written.check()
    }

    /// No time is promised: the link alone decides about the local original.
    pub fn is_of_link(&self) -> bool {
        matches!(self.measure, Measure::Link { .. })
    }

    /// The times of one service, action or input.
    pub fn times(&self, name: &str) -> Times {
        self.requests.get(name).copied().unwrap_or(Times {
            t_desire: self.t_desire,
            t_max: self.t_max,
        })
    }
}

impl<'de> Deserialize<'de> for Sla {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        Written::deserialize(from)?
            .check()
            .map_err(serde::de::Error::custom)
    }
}

fn seconds<S: serde::Serializer>(time: &Duration, out: S) -> Result<S::Ok, S::Error> {
    out.serialize_f64(time.as_secs_f64())
}
