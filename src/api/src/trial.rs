//! Trials: `POST /api/v1/services/NAME/trial?kind=bag` (or `image` for a PNG), with the file as the body, returns a
//! [`Trial`].

use serde::{Deserialize, Serialize};

/// Result of feeding recorded inputs to a service. Times are in milliseconds, measured on this machine without any
/// network.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Trial {
    /// Name of the service.
    pub service: String,
    /// Messages published to the service.
    pub inputs: Vec<Fed>,
    /// Topics of the recording that match no input of the service.
    pub unused: Vec<String>,
    /// Messages published by the service.
    pub outputs: Vec<Heard>,
    /// Number of inputs that an answer was expected for.
    pub requests: usize,
    /// Number of these that were answered.
    pub answered: usize,
    /// Response times; absent if nothing was answered.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rrt: Option<Times>,
}

/// Messages sent to an input.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Fed {
    /// Input topic of the service.
    pub topic: String,
    /// Type: `package/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Number of messages published.
    pub sent: usize,
    /// Topics of other names in the recording that were mapped to this input because it is the only one of their type.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub from: Vec<String>,
}

/// Messages received from an output.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Heard {
    /// Output topic of the service.
    pub topic: String,
    /// Type: `package/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Number of messages received.
    pub received: usize,
    /// Size of the last message in bytes.
    pub bytes: usize,
    /// The last message, if it is short enough to show.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last: Option<serde_json::Value>,
}

/// Response times, and SLA values derived from them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Times {
    /// Median.
    pub p50: f64,
    /// 90th percentile.
    pub p90: f64,
    /// Maximum.
    pub max: f64,
    /// Suggested T_desire: 1.5 times the median.
    pub desire: f64,
    /// Suggested T_max: twice the 90th percentile, and at least twice T_desire.
    pub acceptable: f64,
}
