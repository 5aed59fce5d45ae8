//! In which fields two messages of one type differ, and by how much they may.

use serde_json::{Number, Value};

/// Fields that are named of one answer.
pub(super) const FIELDS: usize = 32;
/// Characters of a value that are shown.
const SHOWN: usize = 60;

/// What may differ.
#[derive(Debug, Clone)]
pub(crate) struct Tolerance {
    /// Two numbers are the same where they are no farther apart than this; unless both are integers, times the greatest of 1
    /// and of them.
    pub(crate) number: f64,
    /// Fields that may differ with all below them; indices of arrays are written `[]`.
    pub(crate) ignore: Vec<String>,
}

/// A field of which two answers have different values.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Differing {
    pub(crate) field: String,
    pub(crate) present: String,
    pub(crate) candidate: String,
}

impl Differing {
    /// The whole answer.
    pub(crate) fn whole(present: impl Into<String>, candidate: impl Into<String>) -> Differing {
        Differing {
            field: String::new(),
            present: shortened(present.into()),
            candidate: shortened(candidate.into()),
        }
    }
}

/// The fields in which two messages of one type differ, the first [`FIELDS`] of them. Of a header, the number and the stamp are
/// left out: both say when something was published, and that is at different times.
pub(crate) fn differences(
    present: &Value,
    candidate: &Value,
    tolerance: &Tolerance,
) -> Vec<Differing> {
    let mut found = Vec::new();
    look(String::new(), present, candidate, tolerance, &mut found);
    found
}

fn look(
    field: String,
    present: &Value,
    candidate: &Value,
    tolerance: &Tolerance,
    found: &mut Vec<Differing>,
) {
    if found.len() >= FIELDS || tolerance.ignore.contains(&field) {
        return;
    }
    let differs = |present: String, candidate: String| Differing {
        field: field.clone(),
        present: shortened(present),
        candidate: shortened(candidate),
    };
    match (present, candidate) {
        (Value::Object(one), Value::Object(other)) => {
            let header = is_header(present);
            for (name, value) in one {
                if header && name != "frame_id" {
                    continue;
                }
                let path = match field.is_empty() {
                    true => name.clone(),
                    false => format!("{field}.{name}"),
                };
                let against = other.get(name).unwrap_or(&Value::Null);
                look(path, value, against, tolerance, found);
            }
        }
        (Value::Array(one), Value::Array(other)) if one.len() == other.len() => {
            for (one, other) in one.iter().zip(other) {
                look(format!("{field}[]"), one, other, tolerance, found);
            }
        }
        (Value::Array(one), Value::Array(other)) => {
            let elements = |of: &[Value]| format!("{} elements", of.len());
            found.push(differs(elements(one), elements(other)));
        }
        (Value::Number(one), Value::Number(other)) => {
            if !agree(one, other, tolerance.number) {
                found.push(differs(one.to_string(), other.to_string()));
            }
        }
        (one, other) if one == other => {}
        (one, other) => found.push(differs(one.to_string(), other.to_string())),
    }
}

/// Integers count things and name them: a large one is allowed no more than a small one.
fn agree(one: &Number, other: &Number, tolerance: f64) -> bool {
    if let (Some(one), Some(other)) = (one.as_i128(), other.as_i128()) {
        return (one - other).unsigned_abs() as f64 <= tolerance;
    }
    match (one.as_f64(), other.as_f64()) {
        (Some(one), Some(other)) => {
            (one - other).abs() <= tolerance * one.abs().max(other.abs()).max(1.0)
        }
        _ => false,
    }
}

/// Whether it is a `std_msgs/Header` of either ROS: that of ROS 2 has no `seq`.
fn is_header(value: &Value) -> bool {
    let Value::Object(fields) = value else {
        return false;
    };
    let is_time = |stamp: &Value| {
        let parts = stamp.as_object();
        parts.is_some_and(|parts| parts.len() == 2 && parts.values().all(Value::is_number))
    };
    let mut others = fields
        .keys()
        .filter(|name| !matches!(&***name, "seq" | "stamp" | "frame_id"));
    others.next().is_none()
        && fields.get("stamp").is_some_and(is_time)
        && fields.contains_key("frame_id")
}

fn shortened(text: String) -> String {
    let length = text.chars().count();
    if length <= SHOWN {
        return text;
    }
    let head: String = text.chars().take(SHOWN).collect();
    format!("{head}… ({length} characters)")
}
