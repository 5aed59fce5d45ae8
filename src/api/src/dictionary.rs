//! The dictionary of a service: which resources a measure of an SLA costs. `GET /api/v1/services/NAME/sla`.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

use crate::Millis;
use crate::limits::Limits;
use crate::sla::{AUX, Measure, Stated};

/// With these limits, and up to these auxiliary parameters, a servant reaches this value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Row {
    /// Its number, never given twice; 0 in a row that is yet to be written.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub id: i64,
    /// What was measured.
    pub measure: Measure,
    /// What is reached: seconds, or frames per second.
    pub value: f64,
    /// For what it holds: of a number up to this one, of other text just this.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub aux: BTreeMap<String, String>,
    /// With what. Where it says nothing, the service's own limits apply.
    pub limits: Limits,
    /// How it was measured, where it was.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub spread: Option<Spread>,
    /// The revision that was current when it was written.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub revision: Option<u64>,
    /// When it was written; 0 in a row that is yet to be.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = false, value_type = crate::schema::Millis))]
    pub written: Millis,
}

/// How far the requests of a measurement were apart, in the unit of the row's value.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Spread {
    /// Median.
    pub p50: f64,
    /// 95th percentile.
    pub p95: f64,
    /// How many were measured.
    pub requests: u64,
}

/// Rows to write (`PUT /api/v1/services/NAME/sla`): all or none. One of the same measure, value and auxiliary parameters
/// takes an earlier one's place.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct NewRows {
    /// The rows.
    pub rows: Vec<Row>,
    /// All that there were before are removed.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub replace: bool,
}

/// What a robot would get that states something, and why: `GET /api/v1/services/NAME/sla/explain?rrt=100ms`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Explained {
    /// The service.
    pub service: String,
    /// What was stated.
    pub stated: Stated,
    /// The class that the robot would be in.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub class: Option<String>,
    /// Its priority.
    pub priority: i32,
    /// The limits that it would be promised; none where it would be refused.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limits: Option<Limits>,
    /// How they follow, a sentence each.
    pub why: Vec<String>,
    /// Why it would be refused.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub refused: Option<String>,
    /// Rows next to those that are taken, in words.
    pub next: Vec<String>,
    /// Each measure of the SLA, with all rows.
    pub goals: Vec<ExplainedGoal>,
}

/// One measure of an SLA.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct ExplainedGoal {
    /// What is measured.
    pub measure: Measure,
    /// What is wished for: seconds, or frames per second.
    pub desire: f64,
    /// What is acceptable.
    pub bound: f64,
    /// All rows of that measure, the cheapest first.
    pub rows: Vec<Considered>,
}

/// A row that was looked at.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Considered {
    /// The row.
    pub row: Row,
    /// It is taken.
    pub taken: bool,
    /// The reason why it was taken or not.
    pub why: String,
}

/// What it is about, such as `rrt 100ms with aux.width=640`.
impl fmt::Display for Row {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            out,
            "{} {}",
            self.measure.name(),
            self.measure.print(self.value)
        )?;
        for (index, (key, value)) in self.aux.iter().enumerate() {
            let before = if index == 0 { " with" } else { "" };
            write!(out, "{before} {AUX}{key}={value}")?;
        }
        Ok(())
    }
}
