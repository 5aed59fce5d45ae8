//! What servants and the machine did in the last day: `GET /api/v1/history/servants` and `GET /api/v1/history/machine`.
//!
//! Figures are lists of one length, one value for each time; null where none is known. A time is the end of its step. What was not sampled (the
//! daemon was not running) is not there.

use serde::{Deserialize, Serialize};

use crate::Millis;

/// What one servant did; it may have ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct ServantHistory {
    /// Its id.
    pub servant: String,
    /// Its service.
    pub service: String,
    /// Its robot.
    pub robot: String,
    /// When it was asked for.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub began: Millis,
    /// When it was looked at last.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub seen: Millis,
    /// Seconds between two times.
    pub step: u32,
    /// What it did.
    pub figures: ServantFigures,
    /// When its robot was served by the local original instead.
    pub local: Vec<LocalPeriod>,
}

/// Figures of a servant. Where a step is of several samples it has their mean, unless it says otherwise.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct ServantFigures {
    /// When each step ended, milliseconds since 1970-01-01 UTC.
    pub time: Vec<u64>,
    /// Cores used.
    pub cores: Vec<Option<f64>>,
    /// The most of them.
    pub cores_most: Vec<Option<f64>>,
    /// Share of the time in which it wanted to run and had used its cores up, 0 to 1.
    pub throttled: Vec<Option<f64>>,
    /// Bytes of memory; the most.
    pub memory: Vec<Option<f64>>,
    /// Response time that half of the requests did not exceed, milliseconds.
    pub p50: Vec<Option<f64>>,
    /// Response time that 19 of 20 requests did not exceed, milliseconds; the most.
    pub p95: Vec<Option<f64>>,
    /// T_desire, milliseconds; the last.
    pub desire: Vec<Option<f64>>,
    /// T_max, milliseconds; the last.
    pub max: Vec<Option<f64>>,
    /// Q; the least.
    pub satisfaction: Vec<Option<f64>>,
    /// Messages dropped in the step.
    pub dropped: Vec<Option<f64>>,
    /// Median of the time for encoding, milliseconds: of the robot's link with the longest response time, as the four below.
    pub serialise: Vec<Option<f64>>,
    /// On the way to the cloud.
    pub up: Vec<Option<f64>>,
    /// Waiting there for the node.
    pub queue: Vec<Option<f64>>,
    /// In the node.
    pub compute: Vec<Option<f64>>,
    /// On the way back.
    pub down: Vec<Option<f64>>,
}

/// A time in which a robot's node was served by its local original.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct LocalPeriod {
    /// The node.
    pub node: String,
    /// When it began.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub began: Millis,
    /// When it ended; none: it has not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub ended: Option<Millis>,
    /// Why, in the robot's words.
    pub why: String,
}

/// What the machine did.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct MachineHistory {
    /// Seconds between two times.
    pub step: u32,
    /// What it did.
    pub figures: MachineFigures,
}

/// Figures of the machine. Where a step is of several samples it has their mean, unless it says otherwise.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct MachineFigures {
    /// When each step ended, milliseconds since 1970-01-01 UTC.
    pub time: Vec<u64>,
    /// Cores that all servants together used.
    pub cores: Vec<Option<f64>>,
    /// The most of them.
    pub cores_most: Vec<Option<f64>>,
    /// Cores that are promised.
    pub promised: Vec<Option<f64>>,
    /// Bytes of memory that all servants together had; the most.
    pub memory: Vec<Option<f64>>,
    /// Percent of the time in which some thread of them waited for a core.
    pub cpu_waits: Vec<Option<f64>>,
    /// For memory.
    pub memory_waits: Vec<Option<f64>>,
    /// For a disk.
    pub io_waits: Vec<Option<f64>>,
    /// Servants; the most.
    pub servants: Vec<Option<f64>>,
}
