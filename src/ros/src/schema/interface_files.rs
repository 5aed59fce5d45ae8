//! The other forms in which a ROS 2 package has its interfaces beside `.msg`, `.srv` and `.action`: descriptions
//! (`.json`, since Iron) and IDL, which rosidl makes of them and of which a package may have nothing else. Both become
//! definitions in the language of `.msg` here, so that one parser reads all.
//!
//! Comments are in neither, constants are not in descriptions.

mod description;
mod idl;

use std::collections::BTreeMap;

use crate::bus::RosVersion;
use crate::schema::{Registry, SchemaError};

/// Definitions by key ([`Registry::insert`]), of one file.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct InterfaceFile {
    /// The file's own interface; of descriptions also the messages that it contains.
    pub definitions: BTreeMap<String, String>,
    /// Type hashes by type, those of parts (`…_Request`) included; descriptions have them.
    pub hashes: BTreeMap<String, String>,
}

impl InterfaceFile {
    /// Reads `share/PACKAGE/{msg,srv,action}/NAME.json`. `key` is `PACKAGE/msg/NAME` (or `srv`, `action`).
    pub fn read_description(key: &str, json: &str) -> Result<InterfaceFile, SchemaError> {
        description::read(key, json)
    }

    /// Reads the `.idl` beside it.
    pub fn read_idl(key: &str, idl: &str) -> Result<InterfaceFile, SchemaError> {
        idl::read(key, idl)
    }

    /// What a registry is made of that has these definitions alone.
    pub fn registry(&self) -> Result<Registry, SchemaError> {
        Registry::of_definitions(RosVersion::Two, &self.definitions)
    }
}

/// One field in the language of `.msg`.
#[derive(Debug, Clone, Default)]
struct Line {
    /// With the bound of a string.
    one: String,
    /// `[]`, `[3]`, `[<=3]` or nothing.
    brackets: String,
    name: String,
    /// As `.msg` writes values; empty for none.
    value: String,
}

impl Line {
    /// Names cannot hold what ends a line, for they are checked where the text is read; values must not.
    fn append_to(&self, text: &mut String) -> Result<(), String> {
        if self.value.contains(['\n', '\r']) {
            return Err(format!("the value of {} goes over a line", self.name));
        }
        for word in [&self.one, &self.brackets, &self.name] {
            if word.contains(char::is_whitespace) {
                return Err(format!("{word:?} is not a legal name"));
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

/// A text in quotes, as `.msg` has it; it has no way to write one that ends with a backslash.
fn quoted(text: &str) -> String {
    format!("\"{}\"", text.replace('"', "\\\""))
}

/// The definition of `key`, of the texts of its parts by full name (`package/srv/Name_Request`).
fn assemble(key: &str, texts: &BTreeMap<String, String>) -> Result<String, SchemaError> {
    let parts: &[&str] = match key.split('/').nth(1) {
        Some("srv") => &["_Request", "_Response"],
        Some("action") => &["_Goal", "_Result", "_Feedback"],
        _ => &[""],
    };
    let texts = parts.iter().map(|part| {
        let name = format!("{key}{part}");
        let text = texts.get(&name).map(String::as_str);
        text.ok_or(SchemaError::Missing {
            name,
            needed_by: key.to_owned(),
        })
    });
    Ok(texts.collect::<Result<Vec<_>, _>>()?.join("---\n"))
}
