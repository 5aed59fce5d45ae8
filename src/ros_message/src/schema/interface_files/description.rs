//! Type descriptions: `type_description_interfaces/msg/TypeDescription` as JSON, with the hashes of the described
//! types.

use std::collections::BTreeMap;

use serde::Deserialize;

use crate::schema::description::PLACEHOLDER;
use crate::schema::interface_files::{FieldLine, InterfaceFile, assemble, quote};
use crate::schema::{ExceededLimit, MAX_TEXT_BYTES, SchemaError, SyntaxError};

#[derive(Deserialize)]
struct File {
    type_description_msg: Description,
    #[serde(default)]
    type_hashes: Vec<Hash>,
}

#[derive(Deserialize)]
struct Description {
    type_description: Type,
    #[serde(default)]
    referenced_type_descriptions: Vec<Type>,
}

#[derive(Deserialize)]
struct Type {
    type_name: String,
    fields: Vec<Field>,
}

#[derive(Deserialize)]
struct Field {
    name: String,
    r#type: FieldType,
    #[serde(default)]
    default_value: String,
}

#[derive(Deserialize)]
struct FieldType {
    type_id: u8,
    capacity: u64,
    string_capacity: u64,
    nested_type_name: String,
}

#[derive(Deserialize)]
struct Hash {
    type_name: String,
    hash_string: String,
}

pub(super) fn read(key: &str, json: &str) -> Result<InterfaceFile, SchemaError> {
    let fail = |line, reason: SyntaxError| SchemaError::Syntax { name: key.to_owned(), line, reason: Box::new(reason) };
    if json.len() > MAX_TEXT_BYTES {
        return Err(SchemaError::TooLarge { name: key.to_owned(), reason: ExceededLimit::DescriptionBytes });
    }
    let file: File = serde_json::from_str(json).map_err(|error| {
        let reason = SyntaxError::NotADescription(error.to_string());
        fail(error.line(), reason)
    })?;
    let description = file.type_description_msg;
    let mut texts = BTreeMap::new();
    let types = description.referenced_type_descriptions.into_iter();
    for described in types.chain([description.type_description]) {
        let text = definition_text(&described).map_err(|reason| {
            let in_type = SyntaxError::InType { type_name: described.type_name.clone(), reason: Box::new(reason) };
            fail(1, in_type)
        })?;
        texts.insert(described.type_name, text);
    }
    let own = assemble(key, &texts)?;
    let mut definitions: BTreeMap<String, String> =
        texts.into_iter().filter(|(name, _)| name.split('/').nth(1) == Some("msg")).collect();
    definitions.insert(key.to_owned(), own);
    let hashes = file.type_hashes.into_iter();
    Ok(InterfaceFile { definitions, hashes: hashes.map(|it| (it.type_name, it.hash_string)).collect() })
}

fn definition_text(described: &Type) -> Result<String, SyntaxError> {
    let mut text = String::new();
    for field in &described.fields {
        if field.name != PLACEHOLDER {
            field_line(field)?.append_to(&mut text)?;
        }
    }
    Ok(text)
}

/// Converts a field; numbers are those of `type_description_interfaces/msg/FieldType`.
fn field_line(field: &Field) -> Result<FieldLine, SyntaxError> {
    let FieldType { type_id, capacity, string_capacity, .. } = field.r#type;
    let (form, one) = ((type_id.max(1) - 1) / 48, (type_id.max(1) - 1) % 48 + 1);
    let is_text = matches!(one, 17 | 18 | 21 | 22);
    let name = match one {
        1 => field.r#type.nested_type_name.clone(),
        2 => "int8".to_owned(),
        3 => "uint8".to_owned(),
        4 => "int16".to_owned(),
        5 => "uint16".to_owned(),
        6 => "int32".to_owned(),
        7 => "uint32".to_owned(),
        8 => "int64".to_owned(),
        9 => "uint64".to_owned(),
        10 => "float32".to_owned(),
        11 => "float64".to_owned(),
        15 => "bool".to_owned(),
        16 => "byte".to_owned(),
        17 => "string".to_owned(),
        18 => "wstring".to_owned(),
        21 => format!("string<={string_capacity}"),
        22 => format!("wstring<={string_capacity}"),
        _ => {
            return Err(SyntaxError::BadTypeId { field: field.name.clone(), type_id });
        }
    };
    let brackets = match form {
        0 => String::new(),
        1 => format!("[{capacity}]"),
        2 => format!("[<={capacity}]"),
        _ => "[]".to_owned(),
    };
    let value = match (&*field.default_value, form) {
        ("", _) => String::new(),
        (text, 0) if is_text => quote(text),
        (value, 0) => value.to_owned(),
        (list, _) => tuple_to_list(list),
    };
    Ok(FieldLine { one: name, brackets, name: field.name.clone(), value })
}

/// Converts a Python tuple to a `.msg` list.
pub(super) fn tuple_to_list(tuple: &str) -> String {
    let inside = tuple.trim();
    let inside = inside.strip_prefix('(').unwrap_or(inside);
    let inside = inside.strip_suffix(')').unwrap_or(inside);
    format!("[{inside}]")
}
