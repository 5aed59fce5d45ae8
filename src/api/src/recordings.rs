//! Recordings of the traffic of a servant before a failure: `GET /api/v1/recordings`.

use serde::{Deserialize, Serialize};

use crate::Millis;
use crate::size::Size;

/// A recording of the last seconds of a servant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Recording {
    /// Recording number; the file is at `GET /api/v1/recordings/NUMBER`.
    pub number: u64,
    /// Name of the service.
    pub service: String,
    /// Name of the robot.
    pub robot: String,
    /// Id of the servant.
    pub servant: String,
    /// Time when the file was written.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub time: Millis,
    /// Reason for the recording.
    pub why: String,
    /// Duration from the first to the last message in seconds; latched messages from before are included in the file.
    pub seconds: f64,
    /// Number of messages.
    pub messages: u64,
    /// Size of the file in bytes.
    pub bytes: Size,
}
