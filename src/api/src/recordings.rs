//! What flowed in a servant before something went wrong: `GET /api/v1/recordings`.

use serde::{Deserialize, Serialize};

use crate::Millis;
use crate::size::Size;

/// A file of the last seconds of a servant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Recording {
    /// Its number; `GET /api/v1/recordings/NUMBER` is the file.
    pub number: u64,
    /// The service.
    pub service: String,
    /// The robot.
    pub robot: String,
    /// The servant's id.
    pub servant: String,
    /// When it was written.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub time: Millis,
    /// Why it was written.
    pub why: String,
    /// From its first message to its last, in seconds; what was latched before is in it, too.
    pub seconds: f64,
    /// Messages.
    pub messages: u64,
    /// Bytes of the file.
    pub bytes: Size,
}
