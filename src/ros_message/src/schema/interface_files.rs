//! Alternative formats of ROS 2 interfaces beside `.msg`, `.srv` and `.action`: descriptions (`.json`, since Iron) and
//! IDL, which rosidl generates, and which may be the only form in a package. Both are converted to the `.msg` language,
//! so that one parser reads all.
//!
//! Neither format has comments; descriptions have no constants.

mod description;
mod idl;

use std::collections::BTreeMap;

use crate::RosVersion;
use crate::schema::{Registry, SchemaError, SyntaxError};

pub use self::idl::IdlError;

/// Contents of one interface file: definitions by key (see [`Registry::insert`]).
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct InterfaceFile {
    /// The file's own interface; for descriptions, also the messages it contains.
    pub definitions: BTreeMap<String, String>,
    /// Type hashes by type, including those of parts (`…_Request`); only descriptions have them.
    pub hashes: BTreeMap<String, String>,
}

impl InterfaceFile {
    /// Reads `share/PACKAGE/{msg,srv,action}/NAME.json`. `key` is `PACKAGE/msg/NAME` (or `srv`, `action`).
    pub fn read_description(key: &str, json: &str) -> Result<InterfaceFile, SchemaError> {
        description::read(key, json)
    }

    /// Reads the `.idl` file beside it.
    pub fn read_idl(key: &str, idl: &str) -> Result<InterfaceFile, SchemaError> {
        idl::read(key, idl)
    }

    /// Returns a registry of these definitions alone.
    pub fn registry(&self) -> Result<Registry, SchemaError> {
        Registry::with_definitions(RosVersion::Two, &self.definitions)
    }
}

/// One field in the `.msg` language.
#[derive(Debug, Clone, Default)]
struct FieldLine {
    /// Type of a single value, including the bound of a string.
    one: String,
    /// `[]`, `[3]`, `[<=3]` or empty.
    brackets: String,
    name: String,
    /// Value in the notation of `.msg`; empty for none.
    value: String,
}

impl FieldLine {
    /// Appends the line. Names are checked where the text is read and cannot contain line breaks; values are checked
    /// here.
    fn append_to(&self, text: &mut String) -> Result<(), SyntaxError> {
        if self.value.contains(['\n', '\r']) {
            return Err(SyntaxError::ValueOverLine(self.name.clone()));
        }
        for word in [&self.one, &self.brackets, &self.name] {
            if word.contains(char::is_whitespace) {
                return Err(SyntaxError::BadIdentifier(word.clone()));
            }
        }
        text.push_str(&self.one);
        text.push_str(&self.brackets);
        text.push(' ');
        text.push_str(&self.name);
        if !self.value.is_empty() {
            text.push(' ');
            text.push_str(&self.value);
        }
        text.push('\n');
        Ok(())
    }
}

/// Quotes a text for `.msg`, which has no way to write one that ends with a backslash.
fn quote(text: &str) -> String {
    format!("\"{}\"", text.replace('"', "\\\""))
}

/// Assembles the definition of `key` from the texts of its parts, by full name (`package/srv/Name_Request`).
fn assemble(key: &str, texts: &BTreeMap<String, String>) -> Result<String, SchemaError> {
    let parts: &[&str] = match key.split('/').nth(1) {
        Some("srv") => &["_Request", "_Response"],
        Some("action") => &["_Goal", "_Result", "_Feedback"],
        _ => &[""],
    };
    let texts = parts.iter().map(|part| {
        let name = format!("{key}{part}");
        let text = texts.get(&name).map(String::as_str);
        text.ok_or(SchemaError::Missing { name, needed_by: key.to_owned() })
    });
    Ok(texts.collect::<Result<Vec<_>, _>>()?.join("---\n"))
}
