//! Values of parameters in both ROSes.
//!
//! | ROS 1, at the Master | ROS 2, at the node | |
//! |---|---|---|
//! | bool | bool | |
//! | int, 32 bits | integer, 64 bits | a wider one does not become a ROS 1 parameter |
//! | double | double | a node takes `1` for a double, and `1.0` for an integer |
//! | string | string | |
//! | base64 | byte array | |
//! | list of bools, ints, doubles or strings | array | of ints and doubles: doubles |
//! | empty list | array | of the type that the node's parameter has |
//! | dictionary | a parameter for each value | names are joined by dots |
//! | list of lists, of dictionaries or of several kinds | refused | |
//! | nil | not set | |

use std::collections::BTreeMap;

use ros::bus::parameter_names::spell_in_ros2;
use ros::bus::{ParamValue, ParameterKind};
use ros::codec::put::CdrWriter;
use ros::ros1::xmlrpc::MAX_DEPTH;
use ros::ros2::parameters::values::{self, TypedValue};

/// Reasons why a value of one ROS is none in the other.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ParameterRefusal {
    /// ROS 2 has no such arrays.
    #[error(
        "a list of {0} cannot be a ROS 2 parameter, whose lists hold bools, numbers or strings; use one list for each"
    )]
    ListOf(
        /// Type of the list's elements.
        &'static str,
    ),
    /// Nil, which ROS 1 does not define.
    #[error("it has no value (nil)")]
    Nil,
    /// No name of a parameter in ROS 2, or none that can be given on a command line.
    #[error("{0:?} cannot be the name of a ROS 2 parameter")]
    Name(
        /// The name.
        String,
    ),
    /// No key at a Master.
    #[error("{0:?} cannot be the name of a ROS 1 parameter")]
    Key(
        /// The name.
        String,
    ),
    /// XML-RPC has integers of 32 bits.
    #[error("{0} does not fit into the 32 bits of a ROS 1 parameter")]
    WideInteger(
        /// The integer.
        i64,
    ),
    /// A Master refuses it.
    #[error("it has more than {MAX_DEPTH} parts; shorten its name")]
    TooDeep,
    /// A Master holds either a value or a dictionary at a name.
    #[error("there are parameters below it, and ROS 1 cannot hold both")]
    HasParametersBelow,
    /// A Master holds either a value or a dictionary at a name.
    #[error("{0} above it has a value, and ROS 1 cannot hold both")]
    BelowValue(
        /// Name of the parameter above.
        String,
    ),
}

/// Parameters of a node, and those that it cannot have.
#[derive(Debug, Default, PartialEq)]
pub(super) struct NodeValues {
    /// Values by name.
    pub(super) values: Vec<(String, ParamValue)>,
    pub(super) refused: Vec<(String, ParameterRefusal)>,
}

impl NodeValues {
    /// Adds the parameters that the value of this name becomes in ROS 2.
    pub(super) fn add(&mut self, name: String, value: ParamValue) {
        if let ParamValue::Map(entries) = value {
            for (entry, value) in entries {
                // A dictionary of XML-RPC has any keys.
                self.add(format!("{name}.{}", spell_in_ros2(&entry)), value);
            }
            return;
        }
        match check_for_ros2(&name, &value) {
            Ok(()) => self.values.push((name, value)),
            Err(refusal) => self.refused.push((name, refusal)),
        }
    }
}

fn check_for_ros2(name: &str, value: &ParamValue) -> Result<(), ParameterRefusal> {
    if name.split('.').any(str::is_empty) || name.contains('\0') {
        return Err(ParameterRefusal::Name(name.chars().take(100).collect()));
    }
    let ParamValue::List(items) = value else {
        return match value {
            ParamValue::Nil => Err(ParameterRefusal::Nil),
            _ => Ok(()),
        };
    };
    let is_number = |item: &ParamValue| matches!(item, ParamValue::Int(_) | ParamValue::Double(_));
    if items.iter().any(|item| matches!(item, ParamValue::Map(_))) {
        return Err(ParameterRefusal::ListOf("dictionaries"));
    }
    if items.iter().any(|item| matches!(item, ParamValue::List(_))) {
        return Err(ParameterRefusal::ListOf("lists"));
    }
    let is_one_kind = items.iter().all(|item| matches!(item, ParamValue::Bool(_)))
        || items.iter().all(is_number)
        || items.iter().all(|item| matches!(item, ParamValue::String(_)));
    if is_one_kind { Ok(()) } else { Err(ParameterRefusal::ListOf("values of several kinds")) }
}

/// Checks that a Master can hold the value of a node's parameter.
pub(super) fn check_for_ros1(value: &ParamValue) -> Result<(), ParameterRefusal> {
    match value {
        ParamValue::Int(number) if i32::try_from(*number).is_err() => Err(ParameterRefusal::WideInteger(*number)),
        ParamValue::List(items) => items.iter().try_for_each(check_for_ros1),
        ParamValue::Map(entries) => entries.values().try_for_each(check_for_ros1),
        ParamValue::Nil => Err(ParameterRefusal::Nil),
        _ => Ok(()),
    }
}

/// Writes a value into a message of ROS 2. One that is missing, or that ROS 2 does not have, is not set.
pub(super) fn write_typed(value: Option<ParamValue>, put: &mut CdrWriter) {
    let typed = value.and_then(|value| values::coerce(value, ParameterKind::NotSet).ok());
    values::write(&typed.unwrap_or(TypedValue::NotSet), put);
}

/// A tree of values as a Master holds it.
pub(super) type Tree = BTreeMap<String, ParamValue>;

/// Returns whether a key or path has more levels than a Master allows.
pub(super) fn is_too_deep(path: &str) -> bool {
    path.split('/').nth(MAX_DEPTH + 1).is_some()
}

/// Puts a value into the tree at a path with slashes, and replaces what was there. A dictionary is merged with the one
/// that is there. A path that is too deep is left out: trees are walked and dropped by recursion, and whoever names
/// parameters must not decide how deep that goes.
pub(super) fn put_at(tree: &mut Tree, path: &str, value: ParamValue) {
    if is_too_deep(path) {
        return;
    }
    put_below(tree, path, value);
}

fn put_below(tree: &mut Tree, path: &str, value: ParamValue) {
    match path.split_once('/') {
        Some((first, rest)) => {
            let below = tree.entry(first.to_owned()).or_insert_with(|| ParamValue::Map(Tree::new()));
            if !matches!(below, ParamValue::Map(_)) {
                *below = ParamValue::Map(Tree::new());
            }
            if let ParamValue::Map(below) = below {
                put_below(below, rest, value);
            }
        }
        None => match (tree.get_mut(path), value) {
            (Some(ParamValue::Map(there)), ParamValue::Map(entries)) => {
                entries.into_iter().for_each(|(entry, value)| put_at(there, &entry, value));
            }
            (_, value) => {
                tree.insert(path.to_owned(), value);
            }
        },
    }
}

/// Returns the value at a path with slashes.
pub(super) fn value_at<'t>(tree: &'t Tree, path: &str) -> Option<&'t ParamValue> {
    let (first, rest) = match path.split_once('/') {
        Some((first, rest)) => (first, Some(rest)),
        None => (path, None),
    };
    match (tree.get(first)?, rest) {
        (value, None) => Some(value),
        (ParamValue::Map(below), Some(rest)) => value_at(below, rest),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use ros::bus::parameter_names::spell_in_ros1;

    use super::*;

    fn value(json: &str) -> ParamValue {
        serde_json::from_str(json).expect(json)
    }

    fn node_values(json: &str) -> NodeValues {
        let mut values = NodeValues::default();
        values.add("a".to_owned(), value(json));
        values
    }

    #[test]
    fn a_tree_is_no_deeper_than_at_a_master() {
        let mut tree = Tree::new();
        let deepest = ["d"; MAX_DEPTH].join("/");
        put_at(&mut tree, &deepest, value("1"));
        assert_eq!(value_at(&tree, &deepest), Some(&value("1")));
        // Dropping it would take more than the stack has.
        put_at(&mut tree, &"/d".repeat(200_000)[1..], value("2"));
        assert_eq!(value_at(&tree, &deepest), Some(&value("1")));
    }

    #[test]
    fn what_both_have_is_carried_unchanged() {
        for json in ["true", "-7", "9223372036854775807", "0.5", r#""x""#, "[]", "[true]", "[1, 2.5]", r#"["x", ""]"#] {
            let carried = node_values(json);
            assert_eq!(carried.values, [("a".to_owned(), value(json))]);
            assert!(carried.refused.is_empty(), "{json}");
        }
        let bytes = ParamValue::Binary(vec![1, 2]);
        assert_eq!(check_for_ros2("a", &bytes), Ok(()));
        assert_eq!(check_for_ros1(&bytes), Ok(()));
    }

    #[test]
    fn dictionaries_become_dotted_names_and_these_become_dictionaries() {
        let carried = node_values(r#"{"gains": {"p": 1, "i": {"x": 2}}, "b/c": 3, "none": {}}"#);
        let names: Vec<_> = carried.values.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names, ["a.b.c", "a.gains.i.x", "a.gains.p"]);
        let mut tree = Tree::new();
        for (name, value) in carried.values {
            put_at(&mut tree, &spell_in_ros1(&name), value);
        }
        assert_eq!(ParamValue::Map(tree), value(r#"{"a": {"gains": {"p": 1, "i": {"x": 2}}, "b": {"c": 3}}}"#));
    }

    #[test]
    fn what_cannot_be_carried_is_refused_by_its_reason() {
        for (json, refusal) in [
            ("[[1]]", ParameterRefusal::ListOf("lists")),
            (r#"[{"x": 1}]"#, ParameterRefusal::ListOf("dictionaries")),
            (r#"[1, "x"]"#, ParameterRefusal::ListOf("values of several kinds")),
            ("[true, 1]", ParameterRefusal::ListOf("values of several kinds")),
        ] {
            assert_eq!(node_values(json).refused, [("a".to_owned(), refusal)], "{json}");
        }
        let empty = node_values(r#"{"": 1, "b": 2}"#);
        assert_eq!(empty.refused, [("a.".to_owned(), ParameterRefusal::Name("a.".to_owned()))]);
        assert_eq!(empty.values, [("a.b".to_owned(), ParamValue::Int(2))], "the others are carried");
        assert_eq!(check_for_ros2("a", &ParamValue::Nil), Err(ParameterRefusal::Nil));
        let wide = ParamValue::List(vec![ParamValue::Int(1), ParamValue::Int(1 << 31)]);
        assert_eq!(check_for_ros1(&wide), Err(ParameterRefusal::WideInteger(1 << 31)));
        assert_eq!(check_for_ros1(&ParamValue::Int(i32::MIN.into())), Ok(()));
    }

    #[test]
    fn values_are_found_and_replaced_in_a_tree() {
        let mut tree = Tree::new();
        put_at(&mut tree, "a/b", ParamValue::Int(1));
        put_at(&mut tree, "a", value(r#"{"c": 2}"#));
        assert_eq!(value_at(&tree, "a/b"), Some(&ParamValue::Int(1)));
        assert_eq!(value_at(&tree, "a"), Some(&value(r#"{"b": 1, "c": 2}"#)));
        put_at(&mut tree, "a/b/x", ParamValue::Int(3));
        assert_eq!((value_at(&tree, "a/b/x"), value_at(&tree, "a/c/x")), (Some(&ParamValue::Int(3)), None));
        put_at(&mut tree, "a", ParamValue::Int(4));
        assert_eq!((value_at(&tree, "a"), value_at(&tree, "a/b")), (Some(&ParamValue::Int(4)), None));
    }
}
