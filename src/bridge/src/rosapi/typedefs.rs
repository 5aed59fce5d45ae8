//! `rosapi/TypeDef`: a type and all it contains, field by field, in the format of rosapi in either ROS.

use std::collections::HashSet;
use std::sync::Arc;

use ros::bus::RosVersion;
use ros::codec;
use ros::schema::{ActionDef, Arity, Base, Field, MessageType, Primitive, Registry, SchemaError, ServiceDef};
use serde_json::{Value, json};

use super::find_with_own;
use crate::lacking::DefinitionError;
use crate::names::{lookup_name, short_type_name};

/// Accessor of a part of an action.
pub(super) type ActionPart = fn(&ActionDef) -> &Arc<MessageType>;

/// The definitions to search: the servant's, of its ROS.
#[derive(Clone, Copy)]
pub(super) struct Definitions<'r> {
    pub(super) version: RosVersion,
    pub(super) registry: &'r Registry,
}

impl Definitions<'_> {
    /// Describes a message.
    pub(super) fn message(self, type_name: &str) -> Result<Value, DefinitionError> {
        if self.version == RosVersion::One
            && let Some(special) = time_typedef(&short_type_name(type_name))
        {
            return Ok(json!({ "typedefs": [special] }));
        }
        if Primitive::from_versioned_name(self.version, type_name).is_some() || is_idl_primitive(type_name) {
            return Ok(json!({ "typedefs": [] }));
        }
        self.details(type_name, |registry, name| registry.message(name))
    }

    /// Describes the request of a service.
    pub(super) fn request(self, type_name: &str) -> Result<Value, DefinitionError> {
        self.service_part(type_name, |service| &service.request)
    }

    /// Describes the response of a service.
    pub(super) fn response(self, type_name: &str) -> Result<Value, DefinitionError> {
        self.service_part(type_name, |service| &service.response)
    }

    fn service_part(
        self,
        type_name: &str,
        part: fn(&ServiceDef) -> &Arc<MessageType>,
    ) -> Result<Value, DefinitionError> {
        self.details(type_name, |registry, name| registry.service(name).map(|service| part(&service).clone()))
    }

    /// Describes a part of an action.
    pub(super) fn action_part(self, type_name: &str, part: ActionPart) -> Result<Value, DefinitionError> {
        self.details(type_name, |registry, name| registry.action(name).map(|action| part(&action).clone()))
    }

    fn details(
        self,
        type_name: &str,
        find: impl Fn(&Registry, &str) -> Result<Arc<MessageType>, SchemaError>,
    ) -> Result<Value, DefinitionError> {
        let name = lookup_name(self.version, type_name);
        let found = find_with_own(self.version, self.registry, |registry| find(registry, &name));
        let found = found.map_err(|error| DefinitionError::new(self.version, error))?;
        Ok(typedefs(&found))
    }
}

fn typedefs(message: &Arc<MessageType>) -> Value {
    let mut found = Vec::new();
    collect(message, &mut HashSet::new(), &mut found);
    json!({ "typedefs": found })
}

/// Collects the type, then those of its fields, each once, in the order of their occurrence.
fn collect(message: &Arc<MessageType>, seen: &mut HashSet<String>, found: &mut Vec<Value>) {
    if !seen.insert(message.name().to_owned()) {
        return;
    }
    found.push(typedef(message));
    for field in message.fields() {
        match &field.base {
            Base::Message(inner) => collect(inner, seen, found),
            Base::Primitive(primitive) => {
                if let Some(special) = time_typedef(primitive.name())
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
        RosVersion::Two => serde_json::from_str(&codec::default_json(message)).unwrap_or(Value::Null),
    };
    json!({
        "type": short_type_name(message.name()),
        "fieldnames": fields.iter().map(|field| &field.name).collect::<Vec<_>>(),
        "fieldtypes": fields.iter().map(|field| rosapi_type_name(version, field)).collect::<Vec<_>>(),
        "fieldarraylen": fields.iter().map(|field| array_length(field.arity)).collect::<Vec<_>>(),
        "examples": fields.iter().map(|field| example(field, &defaults)).collect::<Vec<_>>(),
        "constnames": constants.iter().map(|constant| &constant.name).collect::<Vec<_>>(),
        "constvalues": constants.iter().map(|constant| &constant.value).collect::<Vec<_>>(),
    })
}

/// Returns the name of a field's type in rosapi: in ROS 2 that of IDL.
fn rosapi_type_name(version: RosVersion, field: &Field) -> String {
    let name = match (version, &field.base) {
        (RosVersion::One, _) => return field.type_name.clone(),
        (RosVersion::Two, Base::Message(inner)) => {
            return short_type_name(inner.name()).into_owned();
        }
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

/// Returns whether rosapi of ROS 2 uses this name for a type without a definition.
fn is_idl_primitive(name: &str) -> bool {
    matches!(name, "boolean" | "octet" | "float" | "double")
}

/// Returns -1 for a single value, 0 for a list of any length, or the fixed length.
fn array_length(arity: Arity) -> i64 {
    match arity {
        Arity::One => -1,
        Arity::Variable => 0,
        Arity::Fixed(count) => i64::from(count),
    }
}

/// Formats the default as Python prints it; `defaults` are those of all fields if not all are zeros.
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

/// Describes the time types of ROS 1, which have no definition.
fn time_typedef(name: &str) -> Option<Value> {
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
