//! Live updates of the web page: `GET /api/v1/stream`, as server-sent events (WHATWG HTML, 9.2).
//!
//! ```text
//!   event: snapshot   the complete state, which replaces all earlier events
//!   event: update     the changes since the previous event
//! ```

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::Millis;
use crate::event::Event;
use crate::explain::Served;
use crate::servant::BackOff;
use crate::service::ServiceSummary;
use crate::status::Status;

/// Data of a `snapshot` or `update` event, filtered by what the listener may see.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Update {
    /// Time of the data.
    #[cfg_attr(feature = "schema", schema(required = true, value_type = crate::schema::Millis))]
    pub time: Millis,
    /// The machine; absent if unchanged, or if the listener may not see it.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<Machine>))]
    pub machine: Option<Arc<Machine>>,
    /// New or changed services.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false, value_type = Vec<ServiceSummary>))]
    pub services: Vec<Arc<ServiceSummary>>,
    /// Names of removed services.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub services_gone: Vec<String>,
    /// New or changed servants, with the links of their robots.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false, value_type = Vec<Served>))]
    pub servants: Vec<Arc<Served>>,
    /// Ids of servants that have ended.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub servants_gone: Vec<String>,
    /// All current back-offs; absent if unchanged.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub back_offs: Option<Vec<BackOff>>,
    /// New events, oldest first; in a snapshot, the latest events.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false, value_type = Vec<Event>))]
    pub events: Vec<Arc<Event>>,
}

/// The machine and its current load.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Machine {
    /// Status of the daemon.
    #[serde(flatten)]
    pub status: Status,
    /// CPU usage of all servants together in the last sampling period, in cores.
    pub cores: f64,
    /// Number of cores of the host.
    pub host_cores: usize,
    /// Memory of the host in bytes; absent if unknown.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub host_memory: Option<u64>,
    /// Percentage of the host's memory that is available.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub host_memory_available: Option<f64>,
}
