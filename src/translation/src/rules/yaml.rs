//! Reads a file of rules.

use std::fmt;
use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use serde::Deserialize;
use serde::de::{Deserializer, MapAccess, Visitor};

/// Maximum length of a file of rules.
const MAX_BYTES: usize = 1 << 20;
/// Maximum number of rules in a file.
const MAX_RULES: usize = 4096;

/// An error in a file of rules.
#[derive(Debug, thiserror::Error)]
pub enum RuleError {
    /// The file cannot be read.
    #[error("cannot read the rules in {file}: {error}")]
    Unreadable {
        /// Path of the file.
        file: String,
        /// The problem.
        error: io::Error,
    },
    /// The file is no list of rules; the error names line and column.
    #[error("{file}: {error}; write a list of rules as for ros1_bridge")]
    Yaml {
        /// Name of the file.
        file: String,
        /// The problem and its place.
        error: serde_norway::Error,
    },
    /// The file is too long.
    #[error("{file} has {found} bytes, and a file of rules may have {MAX_BYTES}; divide it")]
    TooLong {
        /// Name of the file.
        file: String,
        /// Length of the file.
        found: usize,
    },
    /// The file has too many rules.
    #[error("{file} has {found} rules, and a file may have {MAX_RULES}; divide it")]
    TooMany {
        /// Name of the file.
        file: String,
        /// Number of rules.
        found: usize,
    },
    /// A rule lacks a key.
    #[error("{place} lacks {key}; add it")]
    Lacks {
        /// File and number of the rule.
        place: String,
        /// The key.
        key: &'static str,
    },
    /// Keys of a rule exclude each other.
    #[error("{place} has both {first} and {second}; write two rules")]
    Excludes {
        /// File and number of the rule.
        place: String,
        /// A key.
        first: &'static str,
        /// The other one.
        second: &'static str,
    },
}

/// A rule.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Rule {
    /// File and number of the rule.
    pub(super) place: String,
    pub(super) one_package: String,
    pub(super) two_package: String,
    pub(super) about: About,
}

/// Pairs of field paths, in the order of the file.
pub(super) type FieldPairs = Vec<(String, String)>;

/// Subject of a rule.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum About {
    Packages,
    Message {
        one: String,
        two: String,
        fields: Option<FieldPairs>,
        one_definition: Option<String>,
        two_definition: Option<String>,
    },
    Service {
        one: String,
        two: String,
        request: Option<FieldPairs>,
        response: Option<FieldPairs>,
    },
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawRule {
    ros1_package_name: Option<String>,
    ros2_package_name: Option<String>,
    ros1_message_name: Option<String>,
    ros2_message_name: Option<String>,
    ros1_service_name: Option<String>,
    ros2_service_name: Option<String>,
    fields_1_to_2: Option<OrderedFields>,
    request_fields_1_to_2: Option<OrderedFields>,
    response_fields_1_to_2: Option<OrderedFields>,
    ros1_definition: Option<String>,
    ros2_definition: Option<String>,
    /// ros1_bridge needs it for rules of one package about another; a lab's file is of none.
    #[serde(default, rename = "enable_foreign_mappings")]
    _enable_foreign_mappings: bool,
}

/// Returns the text of a file of rules.
pub(super) fn read_text(path: &Path) -> Result<String, RuleError> {
    let file = path.display().to_string();
    let unreadable = |error| RuleError::Unreadable { file: file.clone(), error };
    // To open a pipe would wait for its writer.
    let about = std::fs::metadata(path).map_err(unreadable)?;
    if !about.is_file() {
        return Err(unreadable(io::Error::other("it is no file")));
    }
    let found = usize::try_from(about.len()).unwrap_or(usize::MAX);
    if found > MAX_BYTES {
        return Err(RuleError::TooLong { file, found });
    }
    let opened = File::open(path).map_err(unreadable)?;
    let mut text = String::new();
    // It may grow meanwhile; `read` refuses one byte more.
    opened.take(MAX_BYTES as u64 + 1).read_to_string(&mut text).map_err(unreadable)?;
    Ok(text)
}

/// Reads the rules of a file.
pub(super) fn read(file: &str, yaml: &str) -> Result<Vec<Rule>, RuleError> {
    if yaml.len() > MAX_BYTES {
        return Err(RuleError::TooLong { file: file.to_owned(), found: yaml.len() });
    }
    let rules: Option<Vec<RawRule>> =
        serde_norway::from_str(yaml).map_err(|error| RuleError::Yaml { file: file.to_owned(), error })?;
    let rules = rules.unwrap_or_default();
    if rules.len() > MAX_RULES {
        return Err(RuleError::TooMany { file: file.to_owned(), found: rules.len() });
    }
    let numbered = rules.into_iter().enumerate();
    numbered.map(|(index, rule)| rule.check(format!("{file}, rule {}", index + 1))).collect()
}

impl RawRule {
    fn check(self, place: String) -> Result<Rule, RuleError> {
        let lacks = |key| RuleError::Lacks { place: place.clone(), key };
        let one_package = self.ros1_package_name.ok_or_else(|| lacks("ros1_package_name"))?;
        let two_package = self.ros2_package_name.ok_or_else(|| lacks("ros2_package_name"))?;
        let is_message = [
            ("ros1_message_name", self.ros1_message_name.is_some()),
            ("ros2_message_name", self.ros2_message_name.is_some()),
            ("fields_1_to_2", self.fields_1_to_2.is_some()),
            ("ros1_definition", self.ros1_definition.is_some()),
            ("ros2_definition", self.ros2_definition.is_some()),
        ];
        let is_service = [
            ("ros1_service_name", self.ros1_service_name.is_some()),
            ("ros2_service_name", self.ros2_service_name.is_some()),
            ("request_fields_1_to_2", self.request_fields_1_to_2.is_some()),
            ("response_fields_1_to_2", self.response_fields_1_to_2.is_some()),
        ];
        let first_key = |keys: &[(&'static str, bool)]| keys.iter().find(|(_, there)| *there).map(|(key, _)| *key);
        let about = match (first_key(&is_message), first_key(&is_service)) {
            (Some(first), Some(second)) => return Err(RuleError::Excludes { place, first, second }),
            (None, None) => About::Packages,
            (Some(_), None) => About::Message {
                one: self.ros1_message_name.ok_or_else(|| lacks("ros1_message_name"))?,
                two: self.ros2_message_name.ok_or_else(|| lacks("ros2_message_name"))?,
                fields: self.fields_1_to_2.map(|fields| fields.0),
                one_definition: self.ros1_definition,
                two_definition: self.ros2_definition,
            },
            (None, Some(_)) => About::Service {
                one: self.ros1_service_name.ok_or_else(|| lacks("ros1_service_name"))?,
                two: self.ros2_service_name.ok_or_else(|| lacks("ros2_service_name"))?,
                request: self.request_fields_1_to_2.map(|fields| fields.0),
                response: self.response_fields_1_to_2.map(|fields| fields.0),
            },
        };
        Ok(Rule { place, one_package, two_package, about })
    }
}

/// A map whose order is kept: a derived definition has its fields in the order of the rule.
#[derive(Debug)]
struct OrderedFields(FieldPairs);

impl<'de> Deserialize<'de> for OrderedFields {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Pairs;

        impl<'de> Visitor<'de> for Pairs {
            type Value = OrderedFields;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a map of field paths")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<OrderedFields, A::Error> {
                let mut pairs = Vec::new();
                while let Some(pair) = map.next_entry()? {
                    pairs.push(pair);
                }
                Ok(OrderedFields(pairs))
            }
        }

        deserializer.deserialize_map(Pairs)
    }
}
