//! Traffic on the topics of a servant: `GET /api/v1/servants/ID/topics`.

use serde::{Deserialize, Serialize};

/// Topics published within a sampling period of about one second.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct PublishedTopics {
    /// Length of the sampling period, in seconds.
    pub seconds: f64,
    /// Topics, sorted by name.
    pub topics: Vec<PublishedTopic>,
}

/// Traffic on a topic.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct PublishedTopic {
    /// Name of the topic.
    pub topic: String,
    /// Type: `package/Type`.
    #[serde(rename = "type")]
    pub of: String,
    /// Messages per second.
    pub rate: f64,
    /// Bytes per second of serialized messages.
    pub bandwidth: f64,
    /// Median delay from the stamp in a message's header to its arrival here, in seconds; absent for messages without a
    /// header and for stamps of another clock, such as a simulation's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub latency: Option<f64>,
}
