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
    /// Why it would never be admitted, if so: it is more than all that this machine has for servants.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub never: Option<String>,
    /// As many wait as may: one more that would have to wait is refused.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub full: bool,
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
    /// Cores that would be lacking for one more than these.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub beyond_cpus: f64,
    /// Memory that would be lacking for one more than these.
    #[serde(default = "nothing")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub beyond_memory: Size,
    /// How long requests of one more would take, as far as that is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expected: Option<Expected>,
    /// Robots share the servants of this service: so many there are. Where there is one, one more robot needs no room.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shared: Option<u64>,
}

fn nothing() -> Size {
    Size(0)
}

/// How long requests would take.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Expected {
    /// What 19 of 20 do not exceed, seconds.
    pub rrt: f64,
    /// How that is known, in words.
    pub from: String,
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
    /// What 19 of 20 of its requests did not exceed lately, seconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rrt: Option<f64>,
    /// The same with what would be left of the cores.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub later: Option<f64>,
    /// The longest that its robot accepts, seconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub accepts: Option<f64>,
}
