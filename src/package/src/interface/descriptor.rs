//! Parameter descriptors (ROS 2).

use ros::bus::{ParameterDescription, ParameterKind};
use serde::{Deserialize, Serialize};
use serde_json::Number;

/// Descriptor of a node's parameter.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Descriptor {
    /// Type: `bool`, `integer`, `double`, `string`, or an array of these, including `byte_array`; empty if not set.
    #[serde(rename = "type", skip_serializing_if = "String::is_empty")]
    pub kind: String,
    /// Human-readable description.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub description: String,
    /// Human-readable additional constraints.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub constraints: String,
    /// True if the parameter cannot be changed after the node has started.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub read_only: bool,
    /// True if the parameter may change its type.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub dynamic_typing: bool,
    /// Range of allowed values.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub range: Option<Range>,
}

/// Range of allowed values, bounds included; integers for an integer parameter.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Range {
    /// Minimum; absent if unbounded.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub from: Option<Number>,
    /// Maximum; absent if unbounded.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub to: Option<Number>,
    /// Step between allowed values, counted from the minimum; absent if all values in the range are allowed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub step: Option<Number>,
}

/// Maximum length of a text in characters; longer ones are truncated, since they are sent to every client.
const LONGEST_TEXT: usize = 2000;

impl From<ParameterDescription> for Descriptor {
    fn from(said: ParameterDescription) -> Self {
        let doubles = said.double_range.map(|range| Range {
            from: Number::from_f64(range.from),
            to: Number::from_f64(range.to),
            step: Number::from_f64(range.step).filter(|_| range.step != 0.0),
        });
        let integers = said.integer_range.map(|range| Range {
            from: Some(range.from.into()),
            to: Some(range.to.into()),
            // TOML integers are signed.
            step: i64::try_from(range.step).ok().filter(|step| *step != 0).map(Number::from),
        });
        Self {
            kind: kind_name(said.kind).to_owned(),
            description: truncate(said.description),
            constraints: truncate(said.constraints),
            read_only: said.read_only,
            dynamic_typing: said.dynamic_typing,
            range: match said.kind {
                ParameterKind::Double | ParameterKind::Doubles => doubles.or(integers),
                _ => integers.or(doubles),
            },
        }
    }
}

impl Descriptor {
    /// Returns the parameter's type.
    pub fn parameter_kind(&self) -> ParameterKind {
        use ParameterKind::{Bool, Bools, Bytes, Double, Doubles, Integer, Integers, String, Strings};
        let all = [Bool, Integer, Double, String, Bytes, Bools, Integers, Doubles, Strings];
        all.into_iter().find(|kind| kind_name(*kind) == self.kind).unwrap_or_default()
    }
}

/// Returns the type name used by ROS 2's tools.
fn kind_name(kind: ParameterKind) -> &'static str {
    match kind {
        ParameterKind::NotSet => "",
        ParameterKind::Bool => "bool",
        ParameterKind::Integer => "integer",
        ParameterKind::Double => "double",
        ParameterKind::String => "string",
        ParameterKind::Bytes => "byte_array",
        ParameterKind::Bools => "bool_array",
        ParameterKind::Integers => "integer_array",
        ParameterKind::Doubles => "double_array",
        ParameterKind::Strings => "string_array",
    }
}

fn truncate(text: String) -> String {
    match text.char_indices().nth(LONGEST_TEXT) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text,
    }
}

#[cfg(test)]
mod tests {
    use ros::bus::{DoubleRange, IntegerRange};

    use super::*;

    #[test]
    fn what_a_node_says_is_kept_as_json_and_toml_can_hold_it() {
        let open = Descriptor::from(ParameterDescription {
            kind: ParameterKind::Double,
            description: "m/s".to_owned(),
            double_range: Some(DoubleRange { from: 0.0, to: f64::INFINITY, step: 0.0 }),
            ..ParameterDescription::default()
        });
        assert_eq!(
            serde_json::to_value(&open).expect("JSON"),
            serde_json::json!({"type": "double", "description": "m/s", "range": {"from": 0.0}})
        );
        let whole = Descriptor::from(ParameterDescription {
            kind: ParameterKind::Integer,
            read_only: true,
            integer_range: Some(IntegerRange { from: -1, to: 9, step: u64::MAX }),
            ..ParameterDescription::default()
        });
        let whole_kind = whole.parameter_kind();
        let written = toml::to_string(&whole).expect("TOML");
        assert_eq!(toml::from_str::<Descriptor>(&written), Ok(whole));
        assert_eq!(whole_kind, ParameterKind::Integer);
        assert_eq!(Descriptor::default().parameter_kind(), ParameterKind::NotSet);
        let long = "ä".repeat(LONGEST_TEXT + 1);
        assert_eq!(truncate(long).chars().count(), LONGEST_TEXT + 1);
    }
}
