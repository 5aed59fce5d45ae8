//! Values compared with the codec's output for the definitions, and their conversion to a parameter's type.

use super::super::reading::ParameterReader;
use super::super::values::*;
use super::super::*;
use std::sync::Arc;

use ros_message::codec::{JsonOptions, from_json, to_json};
use ros_message::schema::MessageType;

fn value_type() -> Arc<MessageType> {
    interfaces::message("rcl_interfaces/msg/ParameterValue").unwrap()
}

fn cdr(of: &MessageType, json: &str) -> Vec<u8> {
    let mut bytes = Vec::new();
    from_json(of, json.as_bytes(), &mut bytes, &Default::default()).unwrap();
    bytes
}

fn read_value(bytes: &[u8]) -> Option<Option<ParamValue>> {
    read(&mut ParameterReader::new(bytes)?)
}

fn int(value: i64) -> ParamValue {
    ParamValue::Int(value)
}

fn text(value: &str) -> ParamValue {
    ParamValue::String(value.to_owned())
}

fn list(items: impl IntoIterator<Item = ParamValue>) -> ParamValue {
    ParamValue::List(items.into_iter().collect())
}

#[test]
fn each_kind_is_written_and_read_as_its_definition_has_it() {
    let large = i64::MAX - 1;
    for (value, field, json) in [
        (ParamValue::Bool(true), "bool_value", "true"),
        (int(large), "integer_value", "9223372036854775806"),
        (ParamValue::Double(-0.5), "double_value", "-0.5"),
        (text("gütig"), "string_value", "\"gütig\""),
        (ParamValue::Binary(vec![1, 2, 255]), "byte_array_value", "\"AQL/\""),
        (list([ParamValue::Bool(true), ParamValue::Bool(false)]), "bool_array_value", "[true,false]"),
        (list([int(-1), int(large)]), "integer_array_value", "[-1,9223372036854775806]"),
        (list([ParamValue::Double(0.25), ParamValue::Double(2.0)]), "double_array_value", "[0.25,2.0]"),
        (list([text(""), text("abc")]), "string_array_value", r#"["","abc"]"#),
    ] {
        let mut put = CdrWriter::new();
        write(&coerce(value.clone(), ParameterKind::NotSet).unwrap(), &mut put);
        let written = put.finish();
        let of = value_type();
        let mut printed = Vec::new();
        to_json(&of, &written, &mut printed, &JsonOptions::default()).unwrap();
        let printed = String::from_utf8(printed).unwrap();
        assert!(printed.contains(&format!("\"{field}\":{json}")), "{printed}");
        assert_eq!(written, cdr(&of, &printed), "{field}");
        assert_eq!(read_value(&written), Some(Some(value)), "{field}");
        for end in 0..written.len() {
            assert_eq!(read_value(&written[..end]), None, "{field} {end}");
        }
    }
    let mut put = CdrWriter::new();
    write(&TypedValue::NotSet, &mut put);
    assert_eq!(read_value(&put.finish()), Some(None));
}

#[test]
fn big_endian_peers_are_understood() {
    let mut bytes = vec![0, 0, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0];
    bytes.extend(5i64.to_be_bytes());
    bytes.extend(0.5f64.to_be_bytes());
    // An empty text with its NUL, padded, and three lists, of which the third has one element.
    bytes.extend([0, 0, 0, 1, 0, 0, 0, 0]);
    bytes.extend([0; 8]);
    bytes.extend([0, 0, 0, 1]);
    // 44 bytes of the body so far.
    bytes.extend([0; 4]);
    bytes.extend((-2i64).to_be_bytes());
    bytes.extend([0; 8]);
    assert_eq!(read_value(&bytes), Some(Some(list([int(-2)]))));
}

#[test]
fn a_value_becomes_one_of_the_parameters_kind_where_nothing_is_lost() {
    use ParameterKind as Kind;
    let exact = 1i64 << 53;
    for (value, kind, expected) in [
        (int(1), Kind::Double, TypedValue::Double(1.0)),
        (int(exact), Kind::Double, TypedValue::Double(exact as f64)),
        (int(exact + 1), Kind::Double, TypedValue::Integer(exact + 1)),
        (int(1), Kind::NotSet, TypedValue::Integer(1)),
        (ParamValue::Double(2.0), Kind::Integer, TypedValue::Integer(2)),
        (ParamValue::Double(2.5), Kind::Integer, TypedValue::Double(2.5)),
        (text("AQI="), Kind::Bytes, TypedValue::Bytes(vec![1, 2])),
        (text("A"), Kind::Bytes, TypedValue::String("A".to_owned())),
        (text("AQI="), Kind::String, TypedValue::String("AQI=".to_owned())),
        (list([int(1), int(2)]), Kind::Doubles, TypedValue::Doubles(vec![1.0, 2.0])),
        (list([int(1), int(2)]), Kind::Bytes, TypedValue::Bytes(vec![1, 2])),
        (list([int(1), int(256)]), Kind::Bytes, TypedValue::Integers(vec![1, 256])),
        (list([int(1), ParamValue::Double(2.0)]), Kind::Integers, TypedValue::Integers(vec![1, 2])),
        (list([int(1), ParamValue::Double(2.0)]), Kind::NotSet, TypedValue::Doubles(vec![1.0, 2.0])),
        (list([]), Kind::Strings, TypedValue::Strings(vec![])),
        (list([]), Kind::Bools, TypedValue::Bools(vec![])),
        (list([text("a")]), Kind::Bools, TypedValue::Strings(vec!["a".to_owned()])),
        (ParamValue::Nil, Kind::Bool, TypedValue::NotSet),
    ] {
        assert_eq!(coerce(value.clone(), kind), Ok(expected), "{value:?} {kind:?}");
    }
    for value in [list([]), list([int(1), text("a")]), list([list([])]), ParamValue::Map(Default::default())] {
        assert!(coerce(value.clone(), Kind::NotSet).is_err(), "{value:?}");
    }
    assert!(coerce(list([]), Kind::Double).is_err());
}

#[test]
fn what_a_stranger_sends_is_bounded() {
    let of = value_type();
    let many = |count: usize| {
        let mut bytes = cdr(&of, r#"{"type":6}"#);
        // The list of bools follows the type, a bool, an integer, a double, an empty text and a list of bytes.
        let at = 4 + 24 + 8 + 4;
        bytes[at..at + 4].copy_from_slice(&(count as u32).to_le_bytes());
        bytes.truncate(at + 4);
        bytes.resize(bytes.len() + count + 64, 0);
        read_value(&bytes)
    };
    assert_eq!(many(3), Some(Some(list([false, false, false].map(ParamValue::Bool)))));
    assert!(many(1 << 20).is_some());
    assert!(many((1 << 20) + 1).is_none());
    assert!(ParameterReader::new(&vec![0; (16 << 20) + 1]).is_none());
    // False lengths.
    let mut bytes = cdr(&of, r#"{"type":9}"#);
    let end = bytes.len();
    bytes[end - 4..].copy_from_slice(&u32::MAX.to_le_bytes());
    assert_eq!(read_value(&bytes), None);
}
