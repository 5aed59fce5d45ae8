//! What the page shows, as it changes: `GET /api/v1/stream`, as server-sent events (WHATWG HTML, 9.2).
//!
//! ```text
//!   event: snapshot   all there is: what was told before is forgotten
//!   event: update     what has changed since
//! ```

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::Millis;
use crate::event::Event;
use crate::explain::Served;
use crate::servant::BackOff;
use crate::service::ServiceSummary;
use crate::status::Status;

/// The data of one event, of `snapshot` and `update` alike: what who listens may see of it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Update {
    /// When it was so.
    #[cfg_attr(feature = "schema", schema(required = true, value_type = crate::schema::Millis))]
    pub time: Millis,
    /// The machine; none: it has not changed, or who listens is not told of it.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<Machine>))]
    pub machine: Option<Arc<Machine>>,
    /// Services that are new or have changed.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false, value_type = Vec<ServiceSummary>))]
    pub services: Vec<Arc<ServiceSummary>>,
    /// Names of services that are not there any more.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub services_gone: Vec<String>,
    /// Servants that are new or have changed, with their robots' links.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false, value_type = Vec<Served>))]
    pub servants: Vec<Arc<Served>>,
    /// Ids of servants that have ended.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub servants_gone: Vec<String>,
    /// All robots whose servants have failed again and again; none: as before.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub back_offs: Option<Vec<BackOff>>,
    /// Events that are new, oldest first; in a snapshot the newest.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false, value_type = Vec<Event>))]
    pub events: Vec<Arc<Event>>,
}

/// The machine and what works there.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Machine {
    /// The daemon at a glance.
    #[serde(flatten)]
    pub status: Status,
    /// Cores that all servants together used in the last moment.
    pub cores: f64,
    /// Cores that the host has.
    pub host_cores: usize,
    /// Bytes of memory that the host has; none where it does not tell.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub host_memory: Option<u64>,
    /// Percent of it that programs could still be given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub host_memory_available: Option<f64>,
}
