//! The schemas of the document as types of TypeScript, for the page.

use serde_json::Value;

/// First lines of the file.
const HEAD: &str = "\
// Types of the API, written by `make types` from the schemas of /api/v1/openapi.json. Do not edit.
// Members are described there. One that is not known is left out: null stands in lists only.
";

/// Writes every schema of the document as a type.
pub fn write_types(document: &Value) -> String {
    let schemas = document["components"]["schemas"].as_object();
    let types = schemas.into_iter().flatten();
    let types: Vec<String> = types.map(|(name, schema)| write_type(name, schema)).collect();
    format!("{HEAD}\n{}", types.join("\n"))
}

/// Writes a schema as an interface if it has members, otherwise as an alias.
fn write_type(name: &str, schema: &Value) -> String {
    let parts: Vec<&Value> = match schema["allOf"].as_array() {
        Some(parts) => parts.iter().collect(),
        None => vec![schema],
    };
    let members: Vec<String> = parts.iter().flat_map(|part| write_members(part)).collect();
    if members.is_empty() {
        return match &choices(schema)[..] {
            [one] => format!("export type {name} = {one};\n"),
            several => format!("export type {name} =\n  | {};\n", several.join("\n  | ")),
        };
    }
    let parents: Vec<String> = parts.iter().filter_map(|part| target(part)).collect();
    let extends = if parents.is_empty() { String::new() } else { format!(" extends {}", parents.join(", ")) };
    format!("export interface {name}{extends} {{\n  {};\n}}\n", members.join(";\n  "))
}

/// Writes the members of an object, with a question mark behind those that may be absent.
fn write_members(schema: &Value) -> Vec<String> {
    let required = schema["required"].as_array();
    let members = schema["properties"].as_object().into_iter().flatten();
    members
        .map(|(name, member)| {
            let is_required = required.is_some_and(|all| all.iter().any(|one| one == name));
            let mut choices = choices(member);
            if is_required {
                format!("{name}: {}", choices.join(" | "))
            } else {
                choices.retain(|choice| choice != "null");
                format!("{name}?: {}", choices.join(" | "))
            }
        })
        .collect()
}

/// Returns the types of which a value of the schema has one.
fn choices(schema: &Value) -> Vec<String> {
    if let Some(target) = target(schema) {
        return vec![target];
    }
    if let Some(words) = schema["enum"].as_array() {
        let words = words.iter().filter_map(Value::as_str);
        return words.map(|word| format!("'{word}'")).collect();
    }
    if let Some(schemas) = schema["oneOf"].as_array() {
        return schemas.iter().flat_map(choices).collect();
    }
    let kinds: Vec<&str> = match &schema["type"] {
        Value::String(kind) => vec![kind.as_str()],
        Value::Array(kinds) => kinds.iter().filter_map(Value::as_str).collect(),
        _ => vec!["unknown"],
    };
    let types = kinds.into_iter().map(|kind| match kind {
        "integer" => "number".to_owned(),
        "array" => write_list(&schema["items"]),
        "object" => write_object(schema),
        kind => kind.to_owned(),
    });
    types.collect()
}

/// Writes the type of a list.
fn write_list(items: &Value) -> String {
    match &choices(items)[..] {
        [one] => format!("{one}[]"),
        several => format!("({})[]", several.join(" | ")),
    }
}

/// Writes the type of an object that has no name.
fn write_object(schema: &Value) -> String {
    let members = write_members(schema);
    if !members.is_empty() {
        return format!("{{ {} }}", members.join("; "));
    }
    let values = &schema["additionalProperties"];
    let values = if values.is_object() { choices(values).join(" | ") } else { "unknown".to_owned() };
    format!("Record<string, {values}>")
}

/// Returns the name of the schema that a reference leads to.
fn target(schema: &Value) -> Option<String> {
    let target = schema["$ref"].as_str()?;
    target.rsplit('/').next().map(str::to_owned)
}
