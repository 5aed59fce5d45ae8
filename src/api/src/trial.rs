//! Trials: `POST /api/v1/services/NAME/trial?kind=bag` (or `image`, a PNG) with the file as body is answered by a [`Trial`].

use serde::{Deserialize, Serialize};

/// What a service made of recorded inputs. Times are in milliseconds, on this machine, without any network.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Trial {
    /// The service.
    pub service: String,
    /// What was published to it.
    pub inputs: Vec<Fed>,
    /// Topics of the recording that the service has no input for.
    pub unused: Vec<String>,
    /// What it published.
    pub outputs: Vec<Heard>,
    /// Inputs whose answer was awaited.
    pub requests: usize,
    /// Of them were answered.
    pub answered: usize,
    /// Response times; none when nothing was answered.
    pub rrt: Option<Times>,
}

/// An input.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Fed {
    /// The service's topic.
    pub topic: String,
    /// `package/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Messages published.
    pub sent: usize,
    /// Topics of other names in the recording that went to it, since it is the only input of their type.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub from: Vec<String>,
}

/// An output.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Heard {
    /// Topic on which the answer came.
    pub topic: String,
    /// `package/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Messages heard.
    pub received: usize,
    /// Size of the last one.
    pub bytes: usize,
    /// The last one, where it is short enough to show.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last: Option<serde_json::Value>,
}

/// Response times and what follows from them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Times {
    /// Median.
    pub p50: f64,
    /// 90th percentile.
    pub p90: f64,
    /// Maximum.
    pub max: f64,
    /// T_desire to begin with: half as much again as the median.
    pub desire: f64,
    /// T_max to begin with: twice the 90th percentile, and at least twice T_desire.
    pub acceptable: f64,
}
