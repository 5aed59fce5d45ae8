//! Parameters as JSON, which has no numbers for infinities and NaN, and no bytes: those are spelt out, as
//! `{"~double": "inf"}` and `{"~base64": "AA=="}`.
//! No parameter is called so, since a ROS name holds no tilde but at its beginning.

use std::collections::BTreeMap;

use base64_simd::STANDARD;
use ros::bus::ParamValue;
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::bounded;

/// The member of a map that is a double which JSON cannot write.
const DOUBLE: &str = "~double";
/// The member of a map that is bytes.
const BYTES: &str = "~base64";

/// Changes that are told at once, at most.
const MOST_CHANGES: usize = 50_000;

/// A value as it is written.
struct Written<'a>(&'a ParamValue);

impl Serialize for Written<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self.0 {
            ParamValue::Bool(truth) => serializer.serialize_bool(*truth),
            ParamValue::Int(number) => serializer.serialize_i64(*number),
            ParamValue::Double(number) if number.is_finite() => serializer.serialize_f64(*number),
            ParamValue::Double(number) => serializer.collect_map([(DOUBLE, number.to_string())]),
            ParamValue::String(text) => serializer.serialize_str(text),
            // Stubs leave it out, and say so.
            ParamValue::Nil => serializer.serialize_str(""),
            ParamValue::Binary(bytes) => {
                serializer.collect_map([(BYTES, STANDARD.encode_to_string(bytes))])
            }
            ParamValue::List(items) => serializer.collect_seq(items.iter().map(Written)),
            ParamValue::Map(members) => {
                serializer.collect_map(members.iter().map(|(name, value)| (name, Written(value))))
            }
        }
    }
}

/// Takes a value from how it was written, in its place: maps that spell a double or bytes become those.
fn take_written(value: &mut ParamValue) {
    match value {
        ParamValue::List(items) => items.iter_mut().for_each(take_written),
        ParamValue::Map(members) => match spelt(members) {
            Some(spelt) => *value = spelt,
            None => members.values_mut().for_each(take_written),
        },
        _ => {}
    }
}

/// The double or the bytes that a map of one member spells.
fn spelt(members: &BTreeMap<String, ParamValue>) -> Option<ParamValue> {
    let (name, ParamValue::String(text)) = members.first_key_value()? else {
        return None;
    };
    match name.as_str() {
        _ if members.len() > 1 => None,
        DOUBLE => Some(ParamValue::Double(text.parse().unwrap_or(f64::NAN))),
        BYTES => Some(ParamValue::Binary(
            STANDARD.decode_to_vec(text).unwrap_or_default(),
        )),
        _ => None,
    }
}

/// For a tree of parameters.
pub(crate) mod tree {
    use super::*;

    pub(crate) fn serialize<S: Serializer>(
        tree: &BTreeMap<String, ParamValue>,
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        serializer.collect_map(tree.iter().map(|(key, value)| (key, Written(value))))
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<BTreeMap<String, ParamValue>, D::Error> {
        // One value, so that the bounds of one hold for all of them.
        match ParamValue::deserialize(deserializer)? {
            ParamValue::Map(mut tree) => {
                tree.values_mut().for_each(take_written);
                Ok(tree)
            }
            _ => Err(D::Error::custom("parameters are a map")),
        }
    }
}

/// For changes.
pub(crate) mod changes {
    use super::*;

    pub(crate) fn serialize<S: Serializer>(
        changes: &[(String, Option<ParamValue>)],
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        let written = changes.iter();
        serializer.collect_seq(written.map(|(key, value)| (key, value.as_ref().map(Written))))
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<Vec<(String, Option<ParamValue>)>, D::Error> {
        let mut changes =
            bounded::list::<_, (String, Option<ParamValue>), MOST_CHANGES>(deserializer)?;
        let values = changes.iter_mut().filter_map(|(_, value)| value.as_mut());
        values.for_each(take_written);
        Ok(changes)
    }
}

#[cfg(test)]
mod tests {
    use crate::control::{FromRobot, Hello};

    use super::*;

    #[test]
    fn what_json_has_not_arrives_as_it_was() {
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
        let hello = Hello {
            parameters: [("scan".to_owned(), map.clone())].into(),
            ..Hello::default()
        };
        let text = serde_json::to_string(&hello).unwrap();
        assert_eq!(
            serde_json::from_str::<Hello>(&text).unwrap(),
            hello,
            "{text}"
        );
        let changed =
            FromRobot::Parameters(vec![("/scan".into(), Some(map)), ("/gone".into(), None)]);
        let text = serde_json::to_string(&changed).unwrap();
        assert_eq!(
            serde_json::from_str::<FromRobot>(&text).unwrap(),
            changed,
            "{text}"
        );
    }
}
