//! Whether one more servant of a service would fit.

use serde::{Deserialize, Serialize};

use crate::size::Size;

/// What `GET /api/v1/services/NAME/fit` answers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Fit {
    /// Cores that one more would be promised.
    pub cpus: f64,
    /// Memory that one more would be promised.
    pub memory: Size,
    /// Cores that are promised to nobody.
    pub free_cpus: f64,
    /// Memory that is promised to nobody.
    pub free_memory: Size,
    /// So many wait for room.
    pub waiting: usize,
    /// Why nobody is admitted now, if so.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stalled: Option<String>,
    /// It would be admitted at once.
    pub now: bool,
    /// Idle servants that would be ended for it.
    pub ends: Vec<String>,
    /// Cores that would be lacking then.
    pub lacking_cpus: f64,
    /// Memory that would be lacking then.
    pub lacking_memory: Size,
    /// Who would have less of the cores than it uses now, if the new one used all that it is promised.
    pub costs: Vec<Cost>,
    /// So many of its kind would fit, idle servants being ended for them; none: as many as one likes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub more: Option<u64>,
}

/// What one more would cost another servant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Cost {
    /// Its id.
    pub servant: String,
    /// Its service.
    pub service: String,
    /// Its robot.
    pub robot: String,
    /// Cores that it uses now.
    pub cpus: f64,
    /// What it would have left of them.
    pub left: f64,
}
