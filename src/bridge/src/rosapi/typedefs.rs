//! `rosapi/TypeDef`: a type and all it contains, field by field, as rosapi of either ROS tells it.

use std::collections::HashSet;
use std::sync::Arc;

use ros::bus::RosVersion;
use ros::codec;
use ros::schema::{
    ActionDef, Arity, Base, Field, MessageType, Primitive, Registry, SchemaError, ServiceDef,
};
use serde_json::{Value, json};

use super::with_own;
use crate::lacking::explain;
use crate::names::{plain_type, sought};

/// A part of an action.
pub(super) type Part = fn(&ActionDef) -> &Arc<MessageType>;

/// Where definitions are looked up: the servant's, of its ROS.
#[derive(Clone, Copy)]
pub(super) struct Definitions<'r> {
    pub(super) version: RosVersion,
    pub(super) registry: &'r Registry,
}

impl Definitions<'_> {
    /// A message.
    pub(super) fn message(self, type_name: &str) -> Result<Value, String> {
        if self.version == RosVersion::One
            && let Some(special) = special(&plain_type(type_name))
        {
            return Ok(json!({ "typedefs": [special] }));
        }
        if Primitive::named(self.version, type_name).is_some() || is_of_idl(type_name) {
            return Ok(json!({ "typedefs": [] }));
        }
        self.details(type_name, |registry, name| registry.message(name))
    }

    /// The request of a service.
    pub(super) fn request(self, type_name: &str) -> Result<Value, String> {
        self.of_service(type_name, |service| &service.request)
    }

    /// The response of a service.
    pub(super) fn response(self, type_name: &str) -> Result<Value, String> {
        self.of_service(type_name, |service| &service.response)
    }

    fn of_service(
        self,
        type_name: &str,
        part: fn(&ServiceDef) -> &Arc<MessageType>,
    ) -> Result<Value, String> {
        self.details(type_name, |registry, name| {
            registry.service(name).map(|service| part(&service).clone())
        })
    }

    /// A part of an action.
    pub(super) fn of_action(self, type_name: &str, part: Part) -> Result<Value, String> {
        self.details(type_name, |registry, name| {
            registry.action(name).map(|action| part(&action).clone())
        })
    }

    fn details(
        self,
        type_name: &str,
        find: impl Fn(&Registry, &str) -> Result<Arc<MessageType>, SchemaError>,
    ) -> Result<Value, String> {
        let name = sought(self.version, type_name);
        let found = with_own(self.version, self.registry, |registry| {
            find(registry, &name)
        });
        let found = found.map_err(|error| explain(self.version, error))?;
        Ok(typedefs(&found))
    }
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
    let version = message.version();
    let fields = message.fields();
    let mut constants: Vec<_> = message.constants().iter().collect();
    constants.sort_by_key(|constant| &constant.name);
    let defaults: Value = match version {
        RosVersion::One => Value::Null,
        RosVersion::Two => {
            serde_json::from_str(&codec::default_json(message)).unwrap_or(Value::Null)
        }
    };
    json!({
        "type": plain_type(message.name()),
        "fieldnames": fields.iter().map(|field| &field.name).collect::<Vec<_>>(),
        "fieldtypes": fields.iter().map(|field| type_of(version, field)).collect::<Vec<_>>(),
        "fieldarraylen": fields.iter().map(|field| array_length(field.arity)).collect::<Vec<_>>(),
        "examples": fields.iter().map(|field| example(field, &defaults)).collect::<Vec<_>>(),
        "constnames": constants.iter().map(|constant| &constant.name).collect::<Vec<_>>(),
        "constvalues": constants.iter().map(|constant| &constant.value).collect::<Vec<_>>(),
    })
}

/// How rosapi calls the type of a field: in ROS 2 by IDL's names.
fn type_of(version: RosVersion, field: &Field) -> String {
    let name = match (version, &field.base) {
        (RosVersion::One, _) => return field.type_name.clone(),
        (RosVersion::Two, Base::Message(inner)) => return plain_type(inner.name()).into_owned(),
        (RosVersion::Two, Base::Primitive(_)) => field.type_name.as_str(),
    };
    let of_idl = match name {
        "bool" => "boolean",
        "byte" => "octet",
        "char" => "uint8",
        "float32" => "float",
        "float64" => "double",
        other => other,
    };
    of_idl.to_owned()
}

/// Whether rosapi of ROS 2 calls a type so that needs no definition.
fn is_of_idl(name: &str) -> bool {
    matches!(name, "boolean" | "octet" | "float" | "double")
}

/// -1 for a single value, 0 for any number of them.
fn array_length(arity: Arity) -> i64 {
    match arity {
        Arity::One => -1,
        Arity::Variable => 0,
        Arity::Fixed(count) => i64::from(count),
    }
}

/// As Python prints the default; `defaults` are those of all fields where not all are zeros.
fn example(field: &Field, defaults: &Value) -> String {
    let zero = match (field.arity, &field.base) {
        (Arity::Variable | Arity::Fixed(_), _) => return "[]".to_owned(),
        (Arity::One, Base::Message(_)) => return "{}".to_owned(),
        (Arity::One, Base::Primitive(primitive)) => match primitive.name() {
            "bool" => "False",
            "float32" | "float64" => "0.0",
            "string" => "",
            "time" | "duration" => "{}",
            _ => "0",
        },
    };
    match defaults.get(&field.name) {
        Some(Value::Bool(true)) => "True".to_owned(),
        Some(Value::Number(number)) => number.to_string(),
        Some(Value::String(text)) => text.clone(),
        _ => zero.to_owned(),
    }
}

/// ROS 1's times, which have no definition.
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
#[path = "typedefs_tests.rs"]
mod tests;
