//! How much flows on the topics of a servant: `GET /api/v1/servants/ID/topics`.

use serde::{Deserialize, Serialize};

/// What was published in the last second or so.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct PublishedTopics {
    /// So long was counted, in seconds.
    pub seconds: f64,
    /// By name.
    pub topics: Vec<PublishedTopic>,
}

/// A topic.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct PublishedTopic {
    /// Its name.
    pub topic: String,
    /// `package/Type`.
    #[serde(rename = "type")]
    pub of: String,
    /// Messages a second.
    pub rate: f64,
    /// Bytes a second, as messages are serialized.
    pub bandwidth: f64,
    /// From the stamp in a message's header to when it was heard here, in seconds, the median; none of messages without a header, and
    /// where stamps are of another time, as a simulation's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub latency: Option<f64>,
}
