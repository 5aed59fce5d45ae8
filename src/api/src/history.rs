//! Metrics of servants and of the machine over the last day: `GET /api/v1/history/servants` and
//! `GET /api/v1/history/machine`.
//!
//! Figures are arrays of equal length with one value per point in time; a value is null if unknown. A time is the end
//! of its step. Periods that were not sampled (because the daemon was not running) are missing.

use serde::{Deserialize, Serialize};

use crate::Millis;

/// Metrics of one servant, which may have ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct ServantHistory {
    /// Id of the servant.
    pub servant: String,
    /// Service of the servant.
    pub service: String,
    /// Robot of the servant.
    pub robot: String,
    /// Time when the servant was requested.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub began: Millis,
    /// Time of the latest sample.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub seen: Millis,
    /// Step between two times, in seconds.
    pub step: u32,
    /// Metrics over time.
    pub figures: ServantFigures,
    /// Periods in which the robot was served by its local originals.
    pub local: Vec<LocalPeriod>,
}

/// Metrics of a servant. A step that covers several samples has their mean unless stated otherwise.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct ServantFigures {
    /// End of each step, in milliseconds since 1970-01-01 UTC.
    pub time: Vec<u64>,
    /// CPU usage in cores.
    pub cores: Vec<Option<f64>>,
    /// Maximum CPU usage in cores.
    pub cores_most: Vec<Option<f64>>,
    /// Fraction of time in which the servant was throttled by its CPU limit, 0 to 1.
    pub throttled: Vec<Option<f64>>,
    /// Maximum memory usage in bytes.
    pub memory: Vec<Option<f64>>,
    /// Median response time in milliseconds.
    pub p50: Vec<Option<f64>>,
    /// Maximum of the 95th percentile of the response time, in milliseconds.
    pub p95: Vec<Option<f64>>,
    /// Latest T_desire in milliseconds.
    pub desire: Vec<Option<f64>>,
    /// Latest T_max in milliseconds.
    pub max: Vec<Option<f64>>,
    /// Minimum of Q.
    pub satisfaction: Vec<Option<f64>>,
    /// Number of messages dropped in the step.
    pub dropped: Vec<Option<f64>>,
    /// Median time for encoding in milliseconds, on the robot's link with the longest response time; the next four
    /// figures are of the same link.
    pub serialise: Vec<Option<f64>>,
    /// Median time for the transfer to the cloud, in milliseconds.
    pub up: Vec<Option<f64>>,
    /// Median time queued for the node, in milliseconds.
    pub queue: Vec<Option<f64>>,
    /// Median time in the node, in milliseconds.
    pub compute: Vec<Option<f64>>,
    /// Median time for the transfer back to the robot, in milliseconds.
    pub down: Vec<Option<f64>>,
}

/// A period in which a node of the robot was served by its local original.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct LocalPeriod {
    /// Name of the node.
    pub node: String,
    /// Start of the period.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub began: Millis,
    /// End of the period; absent if it has not ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub ended: Option<Millis>,
    /// Reason as reported by the robot.
    pub why: String,
}

/// Metrics of the machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct MachineHistory {
    /// Step between two times, in seconds.
    pub step: u32,
    /// Metrics over time.
    pub figures: MachineFigures,
}

/// Metrics of the machine. A step that covers several samples has their mean unless stated otherwise.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct MachineFigures {
    /// End of each step, in milliseconds since 1970-01-01 UTC.
    pub time: Vec<u64>,
    /// CPU usage of all servants together, in cores.
    pub cores: Vec<Option<f64>>,
    /// Maximum CPU usage of all servants together, in cores.
    pub cores_most: Vec<Option<f64>>,
    /// Reserved CPU in cores.
    pub promised: Vec<Option<f64>>,
    /// Maximum memory usage of all servants together, in bytes.
    pub memory: Vec<Option<f64>>,
    /// Percentage of time in which some thread of the servants waited for CPU.
    pub cpu_waits: Vec<Option<f64>>,
    /// Percentage of time in which some thread of the servants waited for memory.
    pub memory_waits: Vec<Option<f64>>,
    /// Percentage of time in which some thread of the servants waited for disk I/O.
    pub io_waits: Vec<Option<f64>>,
    /// Maximum number of servants.
    pub servants: Vec<Option<f64>>,
}
