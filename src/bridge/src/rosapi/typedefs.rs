//! `rosapi/TypeDef`: a type and all it contains, field by field.

use std::collections::HashSet;
use std::sync::Arc;

use ros::schema::{Arity, Base, MessageType, Primitive, Registry};
use serde_json::{Value, json};

use super::with_own;
use crate::lacking::explain;
use crate::names::plain_type;

pub(super) fn message(registry: &Registry, type_name: &str) -> Result<Value, String> {
    let name = plain_type(type_name);
    if let Some(special) = special(&name) {
        return Ok(json!({ "typedefs": [special] }));
    }
    if Primitive::from_name(&name).is_some() {
        return Ok(json!({ "typedefs": [] }));
    }
    let found = with_own(registry, |registry| registry.message(&name));
    found.map(|found| typedefs(&found)).map_err(explain)
}

pub(super) fn request(registry: &Registry, type_name: &str) -> Result<Value, String> {
    let name = plain_type(type_name);
    let found = with_own(registry, |registry| registry.service(&name));
    found.map(|found| typedefs(&found.request)).map_err(explain)
}

pub(super) fn response(registry: &Registry, type_name: &str) -> Result<Value, String> {
    let name = plain_type(type_name);
    let found = with_own(registry, |registry| registry.service(&name));
    found
        .map(|found| typedefs(&found.response))
        .map_err(explain)
}

fn typedefs(message: &Arc<MessageType>) -> Value {
    let mut found = Vec::new();
    collect(message, &mut HashSet::new(), &mut found);
    json!({ "typedefs": found })
}

/// The type, then those of its fields, each once, in the order in which they are met.
fn collect(message: &Arc<MessageType>, seen: &mut HashSet<String>, found: &mut Vec<Value>) {
    if !seen.insert(message.name().to_owned()) {
        return;
    }
    found.push(typedef(message));
    for field in message.fields() {
        match &field.base {
            Base::Message(inner) => collect(inner, seen, found),
            Base::Primitive(primitive) => {
                if let Some(special) = special(primitive.name())
                    && seen.insert(primitive.name().to_owned())
                {
                    found.push(special);
                }
            }
        }
    }
}

fn typedef(message: &MessageType) -> Value {
    let fields = message.fields();
    let mut constants: Vec<_> = message.constants().iter().collect();
    constants.sort_by_key(|constant| &constant.name);
    json!({
        "type": message.name(),
        "fieldnames": fields.iter().map(|field| &field.name).collect::<Vec<_>>(),
        "fieldtypes": fields.iter().map(|field| &field.type_name).collect::<Vec<_>>(),
        "fieldarraylen": fields.iter().map(|field| array_length(field.arity)).collect::<Vec<_>>(),
        "examples": fields.iter().map(|field| example(field.arity, &field.base)).collect::<Vec<_>>(),
        "constnames": constants.iter().map(|constant| &constant.name).collect::<Vec<_>>(),
        "constvalues": constants.iter().map(|constant| &constant.value).collect::<Vec<_>>(),
    })
}

/// -1 for a single value, 0 for any number of them.
fn array_length(arity: Arity) -> i64 {
    match arity {
        Arity::One => -1,
        Arity::Variable => 0,
        Arity::Fixed(count) => i64::from(count),
    }
}

/// As Python prints the default.
fn example(arity: Arity, base: &Base) -> &'static str {
    match (arity, base) {
        (Arity::Variable | Arity::Fixed(_), _) => "[]",
        (Arity::One, Base::Message(_)) => "{}",
        (Arity::One, Base::Primitive(primitive)) => match primitive.name() {
            "bool" => "False",
            "float32" | "float64" => "0.0",
            "string" => "",
            "time" | "duration" => "{}",
            _ => "0",
        },
    }
}

fn special(name: &str) -> Option<Value> {
    matches!(name, "time" | "duration").then(|| {
        json!({
            "type": name,
            "fieldnames": ["secs", "nsecs"],
            "fieldtypes": ["int32", "int32"],
            "fieldarraylen": [-1, -1],
            "examples": ["0", "0"],
            "constnames": [],
            "constvalues": [],
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_type_is_described_with_all_it_contains() {
        let registry = Registry::new();
        registry
            .insert(
                "x/msg/Pair",
                "uint8 ONE=1\nHeader header\nfloat64[2] both\nInner[] more\nbool ok\n",
            )
            .unwrap();
        registry
            .insert("x/msg/Inner", "duration wait\nstring name\n")
            .unwrap();
        let answer = message(&registry, "x/msg/Pair").unwrap();
        let types: Vec<_> = answer["typedefs"]
            .as_array()
            .unwrap()
            .iter()
            .map(|def| def["type"].clone())
            .collect();
        assert_eq!(
            types,
            ["x/Pair", "std_msgs/Header", "time", "x/Inner", "duration"]
        );
        assert_eq!(
            answer["typedefs"][0],
            json!({
                "type": "x/Pair",
                "fieldnames": ["header", "both", "more", "ok"],
                "fieldtypes": ["std_msgs/Header", "float64", "x/Inner", "bool"],
                "fieldarraylen": [-1, 2, 0, -1],
                "examples": ["{}", "[]", "[]", "False"],
                "constnames": ["ONE"],
                "constvalues": ["1"],
            })
        );
        assert!(
            message(&registry, "x/Nothing")
                .unwrap_err()
                .contains("no definition of x/Nothing is known")
        );
        assert_eq!(
            message(&registry, "time").unwrap()["typedefs"][0]["fieldnames"],
            json!(["secs", "nsecs"])
        );
    }

    #[test]
    fn services_are_described_by_halves() {
        let registry = Registry::new();
        registry
            .insert("x/srv/Add", "int64 a\nint64 b\n---\nint64 sum\n")
            .unwrap();
        let asked = request(&registry, "x/Add").unwrap();
        assert_eq!(asked["typedefs"][0]["type"], "x/AddRequest");
        assert_eq!(asked["typedefs"][0]["fieldnames"], json!(["a", "b"]));
        assert_eq!(
            response(&registry, "x/Add").unwrap()["typedefs"][0]["fieldnames"],
            json!(["sum"])
        );
        let own = response(&registry, "rosapi/Topics").unwrap();
        assert_eq!(own["typedefs"][0]["fieldnames"], json!(["topics", "types"]));
    }
}
