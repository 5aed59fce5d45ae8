//! Parameters as JSON, which has no numbers for infinities and NaN, and no bytes: those are spelt out, as
//! `{"~double": "inf"}` and `{"~base64": "AA=="}`.
//! No parameter is called so, since a ROS name holds no tilde but at its beginning.

use std::collections::BTreeMap;

use base64_simd::STANDARD;
use ros::bus::ParamValue;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// A value as it is written.
#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum Written {
    Bool(bool),
    Int(i64),
    Double(f64),
    String(String),
    List(Vec<Written>),
    Spelt(Spelt),
    Bytes(Bytes),
    Map(BTreeMap<String, Written>),
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Spelt {
    #[serde(rename = "~double")]
    double: String,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Bytes {
    #[serde(rename = "~base64")]
    base64: String,
}

impl From<&ParamValue> for Written {
    fn from(value: &ParamValue) -> Self {
        match value {
            ParamValue::Bool(truth) => Self::Bool(*truth),
            ParamValue::Int(number) => Self::Int(*number),
            ParamValue::Double(number) if number.is_finite() => Self::Double(*number),
            ParamValue::Double(number) => Self::Spelt(Spelt {
                double: number.to_string(),
            }),
            ParamValue::String(text) => Self::String(text.clone()),
            // Stubs leave it out, and say so.
            ParamValue::Nil => Self::String(String::new()),
            ParamValue::Binary(bytes) => Self::Bytes(Bytes {
                base64: STANDARD.encode_to_string(bytes),
            }),
            ParamValue::List(items) => Self::List(items.iter().map(Self::from).collect()),
            ParamValue::Map(members) => {
                let members = members.iter();
                Self::Map(
                    members
                        .map(|(key, value)| (key.clone(), value.into()))
                        .collect(),
                )
            }
        }
    }
}

impl From<Written> for ParamValue {
    fn from(written: Written) -> Self {
        match written {
            Written::Bool(truth) => Self::Bool(truth),
            Written::Int(number) => Self::Int(number),
            Written::Double(number) => Self::Double(number),
            Written::Spelt(spelt) => Self::Double(spelt.double.parse().unwrap_or(f64::NAN)),
            Written::Bytes(bytes) => {
                Self::Binary(STANDARD.decode_to_vec(bytes.base64).unwrap_or_default())
            }
            Written::String(text) => Self::String(text),
            Written::List(items) => Self::List(items.into_iter().map(Self::from).collect()),
            Written::Map(members) => {
                let members = members.into_iter();
                Self::Map(members.map(|(key, value)| (key, value.into())).collect())
            }
        }
    }
}

/// For a tree of parameters.
pub(crate) mod tree {
    use super::*;

    pub(crate) fn serialize<S: Serializer>(
        tree: &BTreeMap<String, ParamValue>,
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        serializer.collect_map(tree.iter().map(|(key, value)| (key, Written::from(value))))
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<BTreeMap<String, ParamValue>, D::Error> {
        let tree = BTreeMap::<String, Written>::deserialize(deserializer)?;
        Ok(tree
            .into_iter()
            .map(|(key, value)| (key, value.into()))
            .collect())
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
        serializer.collect_seq(written.map(|(key, value)| (key, value.as_ref().map(Written::from))))
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<Vec<(String, Option<ParamValue>)>, D::Error> {
        let changes = Vec::<(String, Option<Written>)>::deserialize(deserializer)?;
        let changes = changes.into_iter();
        Ok(changes
            .map(|(key, value)| (key, value.map(ParamValue::from)))
            .collect())
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
