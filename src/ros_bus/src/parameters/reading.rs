//! Deserialization of parameter values from JSON and the like: in one pass, with limits on depth and number of values.
//!
//! Nothing is derived here: the code that serde derives for an untagged enum buffers the remaining input at each level,
//! so a 2 MB text nested 100 deep took tens of gigabytes.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::fmt;

use serde::de::{DeserializeSeed, Error, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};

use super::ParamValue;

impl ParamValue {
    /// Maximum nesting of lists and maps; the same as for the Master and XML-RPC.
    pub const MAX_DEPTH: usize = 100;
    /// Maximum number of values in one value, itself included; the same as for XML-RPC.
    pub const MAX_VALUES: usize = 500_000;
}

impl<'de> Deserialize<'de> for ParamValue {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let values = Cell::new(Self::MAX_VALUES);
        let reader = ParamValueReader { depth: Self::MAX_DEPTH, values: &values };
        reader.deserialize(deserializer)
    }
}

/// Reads one value.
#[derive(Clone, Copy)]
struct ParamValueReader<'a> {
    /// Remaining nesting levels of lists and maps.
    depth: usize,
    /// Remaining number of values.
    values: &'a Cell<usize>,
}

impl ParamValueReader<'_> {
    /// Returns the reader for the items of a list or map.
    fn descend<E: Error>(self) -> Result<Self, E> {
        match self.depth.checked_sub(1) {
            Some(depth) => Ok(Self { depth, ..self }),
            None => Err(E::custom(format_args!("lists and maps are nested more than {} deep", ParamValue::MAX_DEPTH))),
        }
    }
}

impl<'de> DeserializeSeed<'de> for ParamValueReader<'_> {
    type Value = ParamValue;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<ParamValue, D::Error> {
        let Some(left) = self.values.get().checked_sub(1) else {
            return Err(D::Error::custom(format_args!("there are more than {} values", ParamValue::MAX_VALUES)));
        };
        self.values.set(left);
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for ParamValueReader<'_> {
    type Value = ParamValue;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("a boolean, number, text, list or map")
    }

    fn visit_bool<E: Error>(self, truth: bool) -> Result<ParamValue, E> {
        Ok(ParamValue::Bool(truth))
    }

    fn visit_i64<E: Error>(self, number: i64) -> Result<ParamValue, E> {
        Ok(ParamValue::Int(number))
    }

    fn visit_u64<E: Error>(self, number: u64) -> Result<ParamValue, E> {
        // Integers beyond 64 bits signed become doubles, as in Python's JSON.
        let whole = i64::try_from(number).map(ParamValue::Int);
        Ok(whole.unwrap_or(ParamValue::Double(number as f64)))
    }

    fn visit_f64<E: Error>(self, number: f64) -> Result<ParamValue, E> {
        Ok(ParamValue::Double(number))
    }

    fn visit_str<E: Error>(self, text: &str) -> Result<ParamValue, E> {
        Ok(ParamValue::String(text.to_owned()))
    }

    fn visit_string<E: Error>(self, text: String) -> Result<ParamValue, E> {
        Ok(ParamValue::String(text))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<ParamValue, A::Error> {
        let reader = self.descend()?;
        let mut items = Vec::new();
        while let Some(item) = list.next_element_seed(reader)? {
            items.push(item);
        }
        items.shrink_to_fit();
        Ok(ParamValue::List(items))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<ParamValue, A::Error> {
        let reader = self.descend()?;
        let mut members = BTreeMap::new();
        while let Some(name) = map.next_key::<String>()? {
            members.insert(name, map.next_value_seed(reader)?);
        }
        Ok(ParamValue::Map(members))
    }
}

#[cfg(test)]
mod tests {
    use std::hash::{BuildHasher, RandomState};

    use super::*;

    fn read(text: &str) -> Result<ParamValue, String> {
        serde_json::from_str(text).map_err(|error: serde_json::Error| error.to_string())
    }

    #[test]
    fn every_kind_of_value_is_read() {
        use ParamValue::{Bool, Double, Int, List, Map, String};
        let text = |text: &str| String(text.to_owned());
        for (json, value) in [
            ("true", Bool(true)),
            ("-3", Int(-3)),
            ("9223372036854775807", Int(i64::MAX)),
            ("9223372036854775808", Double(9_223_372_036_854_775_808.0)),
            ("2.0", Double(2.0)),
            ("1e300", Double(1e300)),
            (r#""a""#, text("a")),
            (r#""\u00e4\n""#, text("ä\n")),
            ("[]", List(vec![])),
            ("[1,[true]]", List(vec![Int(1), List(vec![Bool(true)])])),
            ("{}", Map(BTreeMap::new())),
            (r#"{"b":1,"a":"x","b":2}"#, Map([("a".to_owned(), text("x")), ("b".to_owned(), Int(2))].into())),
        ] {
            assert_eq!(read(json), Ok(value), "{json}");
        }
        for none in ["null", "[1,null]", r#"{"a":null}"#] {
            let error = read(none).expect_err("ROS has no null");
            assert!(error.contains("a boolean, number, text, list or map"), "{error}");
        }
    }

    #[test]
    fn values_are_read_up_to_a_depth() {
        let nested = |depth: usize| format!("{}1{}", "[".repeat(depth), "]".repeat(depth));
        assert!(read(&nested(ParamValue::MAX_DEPTH)).is_ok());
        let error = read(&nested(ParamValue::MAX_DEPTH + 1)).expect_err("deeper");
        assert!(error.contains("more than 100 deep"), "{error}");
        let maps = |depth: usize| format!("{}1{}", r#"{"":"#.repeat(depth), "}".repeat(depth));
        assert!(read(&maps(ParamValue::MAX_DEPTH)).is_ok());
        let error = read(&maps(ParamValue::MAX_DEPTH + 1)).expect_err("deeper");
        assert!(error.contains("more than 100 deep"), "{error}");
    }

    #[test]
    fn values_are_read_up_to_a_number() {
        let list = |count: usize| format!("[{}1]", "1,".repeat(count - 2));
        assert!(read(&list(ParamValue::MAX_VALUES)).is_ok());
        let error = read(&list(ParamValue::MAX_VALUES + 1)).expect_err("more");
        assert!(error.contains("more than 500000 values"), "{error}");
    }

    #[test]
    fn equal_values_have_equal_hashes() {
        let state = RandomState::new();
        let hash = |number: f64| state.hash_one(ParamValue::Double(number));
        assert_eq!(hash(0.0), hash(-0.0));
        assert_eq!(hash(f64::NAN), hash(-f64::NAN));
        assert_ne!(hash(1.0), hash(f64::NAN));
        assert_ne!(hash(1.0), state.hash_one(ParamValue::Int(1)));
    }
}
