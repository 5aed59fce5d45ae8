//! Parameters as JSON, which has no infinities, NaN or bytes. Those are written as `{"~double": "inf"}` and
//! `{"~base64": "AA=="}`. No parameter has such a name, because a ROS name contains a tilde only at its beginning.

use std::collections::BTreeMap;

use base64_simd::STANDARD;
use ros::bus::ParamValue;
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::bounded;

/// Key of a map that represents a double which JSON cannot represent.
const DOUBLE: &str = "~double";
/// Key of a map that represents bytes.
const BYTES: &str = "~base64";

/// Maximum number of changes in one message.
const MOST_CHANGES: usize = 50_000;

type Tree = BTreeMap<String, ParamValue>;
type Change = (String, Option<ParamValue>);

/// A value serialized for the link.
struct JsonParam<'a>(&'a ParamValue);

impl Serialize for JsonParam<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self.0 {
            ParamValue::Bool(truth) => serializer.serialize_bool(*truth),
            ParamValue::Int(number) => serializer.serialize_i64(*number),
            ParamValue::Double(number) if number.is_finite() => serializer.serialize_f64(*number),
            ParamValue::Double(number) => serializer.collect_map([(DOUBLE, number.to_string())]),
            ParamValue::String(text) => serializer.serialize_str(text),
            // Stubs omit such values and log that.
            ParamValue::Nil => serializer.serialize_str(""),
            ParamValue::Binary(bytes) => serializer.collect_map([(BYTES, STANDARD.encode_to_string(bytes))]),
            ParamValue::List(items) => serializer.collect_seq(items.iter().map(JsonParam)),
            ParamValue::Map(members) => {
                serializer.collect_map(members.iter().map(|(name, value)| (name, JsonParam(value))))
            }
        }
    }
}

/// Replaces maps that represent a double or bytes by those, in place.
fn decode_special_values(value: &mut ParamValue) {
    match value {
        ParamValue::List(items) => items.iter_mut().for_each(decode_special_values),
        ParamValue::Map(members) => match parse_special(members) {
            Some(spelt) => *value = spelt,
            None => members.values_mut().for_each(decode_special_values),
        },
        _ => {}
    }
}

/// Returns the double or the bytes that a map with one entry represents.
fn parse_special(members: &BTreeMap<String, ParamValue>) -> Option<ParamValue> {
    let (name, ParamValue::String(text)) = members.first_key_value()? else {
        return None;
    };
    match name.as_str() {
        _ if members.len() > 1 => None,
        DOUBLE => Some(ParamValue::Double(text.parse().unwrap_or(f64::NAN))),
        BYTES => Some(ParamValue::Binary(STANDARD.decode_to_vec(text).unwrap_or_default())),
        _ => None,
    }
}

/// Serialization of a parameter tree.
pub(crate) mod tree {
    use super::*;

    pub(crate) fn serialize<S: Serializer>(tree: &Tree, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(tree.iter().map(|(key, value)| (key, JsonParam(value))))
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Tree, D::Error> {
        // Deserialized as one value, so that the limits for one value apply to all of them.
        match ParamValue::deserialize(deserializer)? {
            ParamValue::Map(mut tree) => {
                tree.values_mut().for_each(decode_special_values);
                Ok(tree)
            }
            _ => Err(D::Error::custom("parameters are a map")),
        }
    }
}

/// Serialization of parameter changes.
pub(crate) mod changes {
    use super::*;

    pub(crate) fn serialize<S: Serializer>(changes: &[Change], serializer: S) -> Result<S::Ok, S::Error> {
        let written = changes.iter();
        serializer.collect_seq(written.map(|(key, value)| (key, value.as_ref().map(JsonParam))))
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<Change>, D::Error> {
        let mut changes = bounded::list::<_, Change, MOST_CHANGES>(deserializer)?;
        let values = changes.iter_mut().filter_map(|(_, value)| value.as_mut());
        values.for_each(decode_special_values);
        Ok(changes)
    }
}

#[cfg(test)]
mod tests {
    use crate::control::{FromRobot, Hello};

    use super::*;

    #[test]
    fn values_that_json_lacks_round_trip() {
        let values = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1.0, 1e300];
        let list = ParamValue::List(values.map(ParamValue::Double).to_vec());
        let map = ParamValue::Map(
            [
                ("range".to_owned(), list),
                ("n".to_owned(), ParamValue::Int(3)),
                ("key".to_owned(), ParamValue::Binary(vec![0, 255, 7])),
                ("text".to_owned(), ParamValue::String("AP8H".into())),
            ]
            .into(),
        );
        let hello = Hello { parameters: [("scan".to_owned(), map.clone())].into(), ..Hello::default() };
        let text = serde_json::to_string(&hello).unwrap();
        assert_eq!(serde_json::from_str::<Hello>(&text).unwrap(), hello, "{text}");
        let changed = FromRobot::Parameters(vec![("/scan".into(), Some(map)), ("/gone".into(), None)]);
        let text = serde_json::to_string(&changed).unwrap();
        assert_eq!(serde_json::from_str::<FromRobot>(&text).unwrap(), changed, "{text}");
    }
}
