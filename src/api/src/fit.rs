//! Admission forecast: room on the machine for one more servant of a service.

use serde::{Deserialize, Serialize};

use crate::size::Size;

/// Response of `GET /api/v1/services/NAME/fit`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Fit {
    /// CPU reservation of one more servant, in cores.
    pub cpus: f64,
    /// Memory reservation of one more servant.
    pub memory: Size,
    /// CPU that is not reserved, in cores.
    pub free_cpus: f64,
    /// Memory that is not reserved.
    pub free_memory: Size,
    /// Number of servants waiting for admission.
    pub waiting: usize,
    /// Reason why admission is currently stalled.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stalled: Option<String>,
    /// Reason why the servant could never be admitted: its reservation exceeds the machine's total capacity for
    /// servants.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub never: Option<String>,
    /// True if the admission queue is full: a servant that would have to wait is refused.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub full: bool,
    /// True if the servant would be admitted immediately.
    pub now: bool,
    /// Idle servants that would be ended to make room.
    pub ends: Vec<String>,
    /// CPU that would still be missing after that, in cores.
    pub lacking_cpus: f64,
    /// Memory that would still be missing after that.
    pub lacking_memory: Size,
    /// Servants that would have less CPU than they use now if the new servant used its whole reservation.
    pub costs: Vec<Cost>,
    /// Number of additional servants of this service that fit if idle ones are ended; absent if unlimited.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub more: Option<u64>,
    /// CPU missing for one more than these, in cores.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub beyond_cpus: f64,
    /// Memory missing for one more than these.
    #[serde(default = "nothing")]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub beyond_memory: Size,
    /// If no cores are requested for the servant, so that its reservation is only nominal: how many would find enough
    /// at the present use.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub at_present_use: Option<UseForecast>,
    /// Expected response time of one more servant, if known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expected: Option<Expected>,
    /// If robots share the servants of this service: the number of running servants. An additional robot needs no room
    /// if there is at least one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shared: Option<u64>,
}

fn nothing() -> Size {
    Size(0)
}

/// Forecast from the cores that servants use now.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct UseForecast {
    /// Cores of the machine that no servant uses now.
    pub unused_cpus: f64,
    /// Cores that a servant of the service uses now, on average; absent if none is running or none uses any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cpus: Option<f64>,
    /// Number of additional servants that these suffice for, within what can be reserved; absent like `cpus`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub more: Option<u64>,
}

/// Expected response time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Expected {
    /// 95th percentile of the response time, in seconds.
    pub rrt: f64,
    /// Description of how the estimate was made.
    pub from: String,
}

/// Effect of one more servant on an existing one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Cost {
    /// Id of the existing servant.
    pub servant: String,
    /// Service of the servant.
    pub service: String,
    /// Robot of the servant.
    pub robot: String,
    /// Current CPU usage, in cores.
    pub cpus: f64,
    /// CPU that would remain available to the servant, in cores.
    pub left: f64,
    /// Recent 95th percentile of the response time, in seconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rrt: Option<f64>,
    /// Estimated 95th percentile with the remaining CPU, in seconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub later: Option<f64>,
    /// Longest response time that the robot accepts, in seconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub accepts: Option<f64>,
}
