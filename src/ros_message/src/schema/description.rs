//! ROS 2 type descriptions (`type_description_interfaces/msg/TypeDescription`) and their hash, which the endpoints of a
//! topic compare (REP 2016, RIHS01).
//!
//! The hash is SHA-256 of the description as canonical JSON: members in the order in which the description's own type
//! defines them, separated by `, ` and `: `, without default values, referenced types sorted by name.

use std::collections::BTreeMap;
use std::fmt::Write;

use sha2::{Digest, Sha256};

use crate::schema::primitive::Primitive;
use crate::schema::types::{Arity, Base, Field, MessageType};

/// Field that rosidl adds to a type without fields, because C has no empty structures.
pub(crate) const PLACEHOLDER: &str = "structure_needs_at_least_one_member";

/// Returns `RIHS01_` followed by the hash in hex.
pub(crate) fn type_hash(message: &MessageType) -> String {
    let hash = Sha256::digest(canonical_json(message));
    format!("RIHS01_{}", hex::encode(hash))
}

fn canonical_json(message: &MessageType) -> String {
    let mut referenced = BTreeMap::new();
    gather(message, &mut referenced);
    let mut json = String::from("{\"type_description\": ");
    write_type(message, &mut json);
    json.push_str(", \"referenced_type_descriptions\": [");
    for (index, inner) in referenced.values().enumerate() {
        if index > 0 {
            json.push_str(", ");
        }
        write_type(inner, &mut json);
    }
    json.push_str("]}");
    json
}

fn gather<'a>(message: &'a MessageType, found: &mut BTreeMap<&'a str, &'a MessageType>) {
    for field in message.fields() {
        if let Base::Message(inner) = &field.base {
            if found.insert(inner.name(), inner).is_none() {
                gather(inner, found);
            }
        }
    }
}

/// Appends a type as JSON. Names are plain ASCII, so there is nothing to escape.
fn write_type(message: &MessageType, json: &mut String) {
    json.push_str(&format!("{{\"type_name\": \"{}\", \"fields\": [", message.name()));
    for (index, field) in message.fields().iter().enumerate() {
        if index > 0 {
            json.push_str(", ");
        }
        let nested = match &field.base {
            Base::Message(inner) => inner.name(),
            Base::Primitive(_) => "",
        };
        let capacity = match field.arity {
            Arity::Fixed(count) => count,
            _ => field.bounds.elements.unwrap_or(0),
        };
        write_field(&field.name, type_id(field), capacity, field.bounds.text.unwrap_or(0), nested, json);
    }
    if message.fields().is_empty() {
        write_field(PLACEHOLDER, UINT8, 0, 0, "", json);
    }
    json.push_str("]}");
}

fn write_field(name: &str, type_id: u8, capacity: u32, string_capacity: u32, nested: &str, json: &mut String) {
    // Writing to a string cannot fail.
    let _ = write!(
        json,
        "{{\"name\": \"{name}\", \"type\": {{\"type_id\": {type_id}, \"capacity\": {capacity}, \
         \"string_capacity\": {string_capacity}, \"nested_type_name\": \"{nested}\"}}}}"
    );
}

const UINT8: u8 = 3;

/// Offsets of array types in `type_description_interfaces/msg/FieldType`, added to the number of the single type.
const ARRAY: u8 = 48;
const BOUNDED_SEQUENCE: u8 = 96;
const UNBOUNDED_SEQUENCE: u8 = 144;

fn type_id(field: &Field) -> u8 {
    let one = match &field.base {
        Base::Message(_) => 1,
        Base::Primitive(Primitive::Uint8) if field.type_name == "byte" => 16,
        Base::Primitive(primitive) => match (primitive, field.bounds.text) {
            (Primitive::Int8, _) => 2,
            (Primitive::Uint8, _) => UINT8,
            (Primitive::Int16, _) => 4,
            (Primitive::Uint16, _) => 5,
            (Primitive::Int32, _) => 6,
            (Primitive::Uint32, _) => 7,
            (Primitive::Int64, _) => 8,
            (Primitive::Uint64, _) => 9,
            (Primitive::Float32, _) => 10,
            (Primitive::Float64, _) => 11,
            (Primitive::Bool, _) => 15,
            (Primitive::String, None) => 17,
            (Primitive::Wstring, None) => 18,
            (Primitive::String, Some(_)) => 21,
            (Primitive::Wstring, Some(_)) => 22,
            // ROS 2 has no such fields.
            (Primitive::Time | Primitive::Duration, _) => 0,
        },
    };
    one + match (field.arity, field.bounds.elements) {
        (Arity::One, _) => 0,
        (Arity::Fixed(_), _) => ARRAY,
        (Arity::Variable, Some(_)) => BOUNDED_SEQUENCE,
        (Arity::Variable, None) => UNBOUNDED_SEQUENCE,
    }
}
