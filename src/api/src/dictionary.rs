//! The dictionary of a service: the resources needed to meet a measure of an SLA. `GET /api/v1/services/NAME/sla`.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

use crate::Millis;
use crate::limits::Limits;
use crate::sla::{AUX, Measure, Stated};

/// A dictionary row: a servant with these limits reaches this value, up to these auxiliary parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Row {
    /// Row number, never reused; 0 in a row that has not been written.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub id: i64,
    /// Measure that the row is about.
    pub measure: Measure,
    /// Value that is reached: seconds, or frames per second.
    pub value: f64,
    /// Auxiliary parameters that the row is valid for: numeric values up to the given number, other values by equality.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub aux: BTreeMap<String, String>,
    /// Resource limits that reach the value. Limits that are absent are the service's own.
    pub limits: Limits,
    /// Statistics of the measurement; absent if the value was not measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub spread: Option<Spread>,
    /// Revision that was current when the row was written.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub revision: Option<u64>,
    /// Time when the row was written; 0 in a row that has not been written.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = false, value_type = crate::schema::Millis))]
    pub written: Millis,
}

/// Distribution of the measured requests, in the unit of the row's value.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Spread {
    /// Median.
    pub p50: f64,
    /// 95th percentile.
    pub p95: f64,
    /// Number of requests measured.
    pub requests: u64,
}

/// Rows to write atomically (`PUT /api/v1/services/NAME/sla`). A row replaces an earlier one with the same measure,
/// value and auxiliary parameters.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct NewRows {
    /// Rows to write.
    pub rows: Vec<Row>,
    /// Remove all existing rows first.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub replace: bool,
}

/// Terms that a robot with the given statement would get, and why: `GET /api/v1/services/NAME/sla/explain?rrt=100ms`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Explained {
    /// Name of the service.
    pub service: String,
    /// The statement of the robot.
    pub stated: Stated,
    /// Class that the robot would be assigned to.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub class: Option<String>,
    /// Priority of the class.
    pub priority: i32,
    /// Limits that would be reserved; absent if the robot would be refused.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limits: Option<Limits>,
    /// Explanation of the limits, one sentence each.
    pub why: Vec<String>,
    /// Reason why the robot would be refused.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub refused: Option<String>,
    /// Descriptions of the rows adjacent to those chosen.
    pub next: Vec<String>,
    /// The measures of the SLA, each with all its rows.
    pub goals: Vec<ExplainedGoal>,
}

/// One measure of an SLA.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct ExplainedGoal {
    /// The measure.
    pub measure: Measure,
    /// Desired value: seconds, or frames per second.
    pub desire: f64,
    /// Worst acceptable value: seconds, or frames per second.
    pub bound: f64,
    /// All rows of the measure, cheapest first.
    pub rows: Vec<Considered>,
}

/// A row that was considered.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Considered {
    /// The row.
    pub row: Row,
    /// True if the row was chosen.
    pub taken: bool,
    /// Reason why the row was or was not chosen.
    pub why: String,
}

/// Writes the row's subject, such as `rrt 100ms with aux.width=640`.
impl fmt::Display for Row {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{} {}", self.measure.name(), self.measure.format_value(self.value))?;
        for (index, (key, value)) in self.aux.iter().enumerate() {
            let before = if index == 0 { " with" } else { "" };
            write!(out, "{before} {AUX}{key}={value}")?;
        }
        Ok(())
    }
}
