//! Finds the fields in which two messages of one type differ, within tolerances.

use serde_json::{Number, Value};

/// Maximum number of fields reported for one answer.
pub(super) const FIELDS: usize = 32;
/// Maximum number of characters shown of a value.
const MAX_SHOWN_VALUE: usize = 60;

/// Tolerated differences.
#[derive(Debug, Clone)]
pub(crate) struct Tolerance {
    /// Maximum distance of two equal numbers; unless both are integers, it is multiplied by the greatest of 1 and their
    /// magnitudes.
    pub(crate) number: f64,
    /// Fields to ignore, including all fields below them; indices of arrays are written `[]`.
    pub(crate) ignore: Vec<String>,
}

/// A field with different values in two answers.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct DifferingField {
    pub(crate) field: String,
    pub(crate) present: String,
    pub(crate) candidate: String,
}

impl DifferingField {
    /// Creates a difference of the whole answers.
    pub(crate) fn whole_answer(present: impl Into<String>, candidate: impl Into<String>) -> DifferingField {
        DifferingField { field: String::new(), present: shorten(present.into()), candidate: shorten(candidate.into()) }
    }
}

/// Returns the fields in which two messages of one type differ, the first [`FIELDS`] of them. The sequence number and
/// stamp of a header are ignored: both depend on the time of publication.
pub(crate) fn differences(present: &Value, candidate: &Value, tolerance: &Tolerance) -> Vec<DifferingField> {
    let mut found = Vec::new();
    compare_fields(String::new(), present, candidate, tolerance, &mut found);
    found
}

fn compare_fields(
    field: String,
    present: &Value,
    candidate: &Value,
    tolerance: &Tolerance,
    found: &mut Vec<DifferingField>,
) {
    if found.len() >= FIELDS || tolerance.ignore.contains(&field) {
        return;
    }
    let differs = |present: String, candidate: String| DifferingField {
        field: field.clone(),
        present: shorten(present),
        candidate: shorten(candidate),
    };
    match (present, candidate) {
        (Value::Object(one), Value::Object(other)) => {
            let header = is_header(present);
            for (name, value) in one {
                if header && name != "frame_id" {
                    continue;
                }
                let path = if field.is_empty() { name.clone() } else { format!("{field}.{name}") };
                let against = other.get(name).unwrap_or(&Value::Null);
                compare_fields(path, value, against, tolerance, found);
            }
        }
        (Value::Array(one), Value::Array(other)) if one.len() == other.len() => {
            for (one, other) in one.iter().zip(other) {
                compare_fields(format!("{field}[]"), one, other, tolerance, found);
            }
        }
        (Value::Array(one), Value::Array(other)) => {
            let elements = |of: &[Value]| format!("{} elements", of.len());
            found.push(differs(elements(one), elements(other)));
        }
        (Value::Number(one), Value::Number(other)) => {
            if !numbers_agree(one, other, tolerance.number) {
                found.push(differs(one.to_string(), other.to_string()));
            }
        }
        (one, other) if one == other => {}
        (one, other) => found.push(differs(one.to_string(), other.to_string())),
    }
}

/// Integers count or identify things: a large one has no larger tolerance than a small one.
fn numbers_agree(one: &Number, other: &Number, tolerance: f64) -> bool {
    if let (Some(one), Some(other)) = (one.as_i128(), other.as_i128()) {
        return (one - other).unsigned_abs() as f64 <= tolerance;
    }
    match (one.as_f64(), other.as_f64()) {
        (Some(one), Some(other)) => (one - other).abs() <= tolerance * one.abs().max(other.abs()).max(1.0),
        _ => false,
    }
}

/// Returns true if the value is a `std_msgs/Header` of ROS 1 or 2; that of ROS 2 has no `seq`.
fn is_header(value: &Value) -> bool {
    let Value::Object(fields) = value else {
        return false;
    };
    let is_time = |stamp: &Value| {
        let parts = stamp.as_object();
        parts.is_some_and(|parts| parts.len() == 2 && parts.values().all(Value::is_number))
    };
    let mut others = fields.keys().filter(|name| !matches!(&***name, "seq" | "stamp" | "frame_id"));
    others.next().is_none() && fields.get("stamp").is_some_and(is_time) && fields.contains_key("frame_id")
}

fn shorten(text: String) -> String {
    let length = text.chars().count();
    if length <= MAX_SHOWN_VALUE {
        return text;
    }
    let head: String = text.chars().take(MAX_SHOWN_VALUE).collect();
    format!("{head}… ({length} characters)")
}
