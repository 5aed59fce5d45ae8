use std::collections::{BTreeMap, BTreeSet};

use serde_json::Value;

use super::{ANY, BASE, FURTHER_REFUSALS, REFUSALS, document};
use crate::route_access::Access;
use crate::routes::ROUTES;

mod samples;
mod typescript;

fn document_json() -> Value {
    serde_json::to_value(document(ROUTES)).expect("plain data")
}

/// Collects every `$ref` in the document.
fn references(value: &Value, found: &mut Vec<String>) {
    match value {
        Value::Object(members) => {
            for (name, member) in members {
                match member.as_str() {
                    Some(target) if name == "$ref" => found.push(target.to_owned()),
                    _ => references(member, found),
                }
            }
        }
        Value::Array(elements) => elements.iter().for_each(|element| references(element, found)),
        _ => {}
    }
}

#[test]
fn every_reference_leads_to_a_schema() {
    let document = document_json();
    let mut found = Vec::new();
    references(&document, &mut found);
    assert!(!found.is_empty());
    for target in found {
        let pointer = target.strip_prefix('#').expect("within the document");
        assert!(document.pointer(pointer).is_some(), "{target} leads nowhere");
    }
}

#[test]
fn two_types_have_no_schema_of_one_name() {
    let mut known: BTreeMap<String, Value> = BTreeMap::new();
    for operation in ROUTES.iter().filter_map(|row| row.operation) {
        for (name, schema) in operation().schemas {
            let schema = serde_json::to_value(schema).expect("plain data");
            let before = known.entry(name.clone()).or_insert_with(|| schema.clone());
            assert_eq!(*before, schema, "{name} is the name of two");
        }
    }
    assert!(known.len() > 50, "{} schemas", known.len());
}

#[test]
fn the_document_lists_exactly_the_routes_of_the_table() {
    let document = document_json();
    let mut listed = BTreeSet::new();
    let mut ids = BTreeSet::new();
    for (path, item) in document["paths"].as_object().expect("paths") {
        for (method, operation) in item.as_object().expect("operations") {
            listed.insert(format!("{} {BASE}{path}", method.to_ascii_uppercase()));
            let id = operation["operationId"].as_str().expect("an id");
            assert!(ids.insert(id.to_owned()), "{id} is the id of two");
        }
    }
    let v1 = ROUTES.iter().filter(|row| row.path.starts_with("/api/v1/"));
    let table: BTreeSet<String> = v1.map(|row| format!("{} {}", row.method, row.path)).collect();
    assert_eq!(listed, table);
}

#[test]
fn every_operation_says_with_what_it_may_be_refused() {
    let document = document_json();
    let mut ids = BTreeSet::new();
    for (path, item) in document["paths"].as_object().expect("paths") {
        for (method, operation) in item.as_object().expect("operations") {
            ids.insert(operation["operationId"].as_str().expect("an id").to_owned());
            let statuses = operation["responses"].as_object().expect("responses");
            let is_refused = |status: &u16| statuses.contains_key(&status.to_string());
            assert!(ANY.iter().all(is_refused), "{method} {path}");
            let is_done = |status: &String| ["1", "2", "3"].iter().any(|s| status.starts_with(s));
            assert!(statuses.keys().any(is_done), "{method} {path}: {statuses:?}");
            assert!(!statuses.contains_key("default"), "{method} {path}");
        }
    }
    let words: BTreeSet<u16> = REFUSALS.iter().map(|(status, _)| *status).collect();
    for (id, statuses) in FURTHER_REFUSALS {
        assert!(ids.contains(*id), "there is no {id}");
        for status in *statuses {
            assert!(words.contains(status), "nothing says what {status} is");
        }
    }
}

#[test]
fn what_the_document_describes_needs_a_token_or_a_pairing_code() {
    for row in ROUTES.iter().filter(|row| row.operation.is_some()) {
        // Except for signing in and for pairing by a code, which is how a caller obtains credentials.
        let guarded = match row.access {
            Access::Code => row.path == "/api/v1/pair",
            Access::SignIn => row.path == "/api/v1/session",
            Access::Read => row.path.starts_with("/api/v1/oidc/"),
            access => matches!(access, Access::May(..)),
        };
        assert!(guarded, "{} {}", row.method, row.path);
    }
}

/// Checks values against schemas and collects the properties encountered, as `SCHEMA.PROPERTY`.
struct SchemaChecker<'a> {
    document: &'a Value,
    met: BTreeSet<String>,
}

impl<'a> SchemaChecker<'a> {
    /// Follows a reference; returns the name and schema to check from there on.
    fn resolve(&self, name: &'a str, schema: &'a Value) -> (&'a str, &'a Value) {
        match schema["$ref"].as_str() {
            None => (name, schema),
            Some(target) => {
                (target.rsplit('/').next().unwrap_or(target), self.document.pointer(&target[1..]).expect("a schema"))
            }
        }
    }

    /// Returns the schemas that a schema consists of, with their names: itself, or those of its `allOf`.
    fn parts(&self, name: &'a str, schema: &'a Value) -> Vec<(&'a str, &'a Value)> {
        let (name, schema) = self.resolve(name, schema);
        match schema["allOf"].as_array() {
            None => vec![(name, schema)],
            Some(all) => all.iter().flat_map(|part| self.parts(name, part)).collect(),
        }
    }

    fn check(&mut self, name: &'a str, schema: &'a Value, value: &Value) -> Result<(), String> {
        let (name, schema) = self.resolve(name, schema);
        if let Some(choices) = schema["oneOf"].as_array() {
            let met = self.met.clone();
            for choice in choices {
                if self.check(name, choice, value).is_ok() {
                    return Ok(());
                }
                self.met.clone_from(&met);
            }
            return Err(format!("{name}: {value} is none of the choices"));
        }
        let kinds: &[&str] = match value {
            Value::Null => &["null"],
            Value::Bool(_) => &["boolean"],
            Value::Number(number) if number.is_f64() => &["number"],
            Value::Number(_) => &["integer", "number"],
            Value::String(_) => &["string"],
            Value::Array(_) => &["array"],
            Value::Object(_) => &["object"],
        };
        let allowed = |kind: &&str| match &schema["type"] {
            Value::String(one) => one == kind,
            Value::Array(several) => several.iter().any(|one| one == kind),
            _ => true,
        };
        if !kinds.iter().any(allowed) {
            return Err(format!("{name}: {value} is no {}", schema["type"]));
        }
        if schema["enum"].as_array().is_some_and(|values| !values.contains(value)) {
            return Err(format!("{name}: {value} is not in {}", schema["enum"]));
        }
        match value {
            Value::Array(elements) => {
                elements.iter().try_for_each(|element| self.check(name, &schema["items"], element))
            }
            Value::Object(_) => self.check_members(name, schema, value),
            _ => Ok(()),
        }
    }

    fn check_members(&mut self, name: &'a str, schema: &'a Value, value: &Value) -> Result<(), String> {
        let parts = self.parts(name, schema);
        for (part, schema) in &parts {
            for required in schema["required"].as_array().into_iter().flatten() {
                let required = required.as_str().unwrap_or_default();
                if value.get(required).is_none() {
                    return Err(format!("{part}: {required} is required, not in {value}"));
                }
            }
        }
        // An object of any kind.
        if parts.iter().all(|(_, schema)| schema["properties"].is_null()) && schema["additionalProperties"].is_null() {
            return Ok(());
        }
        for (key, member) in value.as_object().into_iter().flatten() {
            if member.is_null() {
                return Err(format!("{name}: {key} is null; it has to be left out"));
            }
            let described = parts.iter().find_map(|(part, schema)| Some((*part, schema["properties"].get(key)?)));
            match described {
                Some((part, property)) => {
                    self.met.insert(format!("{part}.{key}"));
                    self.check(part, property, member)?;
                }
                None if !schema["additionalProperties"].is_null() => {
                    self.check(name, &schema["additionalProperties"], member)?;
                }
                None => return Err(format!("{name}: {key} is not described")),
            }
        }
        Ok(())
    }
}

/// Collects the properties that a schema itself defines.
fn own_properties(name: &str, schema: &Value, found: &mut BTreeSet<String>) {
    for property in schema["properties"].as_object().into_iter().flatten() {
        found.insert(format!("{name}.{}", property.0));
    }
    for several in ["allOf", "oneOf"] {
        for part in schema[several].as_array().into_iter().flatten() {
            own_properties(name, part, found);
        }
    }
}

#[test]
fn schemas_are_as_serde_writes() {
    let document = document_json();
    let schemas = &document["components"]["schemas"];
    let mut judge = SchemaChecker { document: &document, met: BTreeSet::new() };
    for (name, value) in samples::samples() {
        assert!(schemas[name].is_object(), "{name} is not described");
        judge.check(name, &schemas[name], &value).expect("as the schema says");
    }
    let mut described = BTreeSet::new();
    for (name, schema) in schemas.as_object().expect("schemas") {
        own_properties(name, schema, &mut described);
    }
    let never: Vec<&String> = described.difference(&judge.met).collect();
    assert!(never.is_empty(), "serde never writes {never:?}");
}

#[test]
fn the_pages_types_are_those_of_the_document() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../web/src/lib/types.ts");
    let types = typescript::write_types(&document_json());
    if std::env::var_os("WRITE_TYPES").is_some() {
        std::fs::write(path, &types).expect("web/src/lib is writable");
    }
    let found = std::fs::read_to_string(path).expect("web/src/lib/types.ts");
    assert!(found == types, "web/src/lib/types.ts is of another document; run `make types`");
}
