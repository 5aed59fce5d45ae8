//! Rules for pairs of types whose names or fields differ, in the YAML syntax of ros1_bridge.
//!
//! A file is a list of rules. Each has `ros1_package_name` and `ros2_package_name`, and is about
//! - the packages, if there is nothing else;
//! - a message: `ros1_message_name`, `ros2_message_name`, and, if their fields differ, `fields_1_to_2`, which lists all
//!   fields that belong together as paths `a.b.c`;
//! - a service: `ros1_service_name`, `ros2_service_name`, and `request_fields_1_to_2`, `response_fields_1_to_2`
//!   likewise.
//!
//! Beyond ros1_bridge's syntax, `.` is the path of the message itself, and a message's rule may have the definition of
//! either side (`ros1_definition`, `ros2_definition`), for the case that it is not known otherwise: a robot of ROS 1
//! refuses a definition with another MD5, which depends on constants too.

mod table;
mod yaml;

use std::collections::HashMap;
use std::path::Path;

use ros_message::RosVersion;

use crate::names::{TypeName, split_part, write_name};

pub use yaml::RuleError;

/// Rules for pairs of types whose names or fields differ. The default is the built-in table.
#[derive(Debug, Clone)]
pub struct TranslationRules {
    packages: Names<String>,
    messages: Names<(String, String)>,
    services: Names<(String, String)>,
    /// By package and message in ROS 1, then in ROS 2; the kind of a ROS 2 name is left out.
    fields: HashMap<(String, String), FieldRule>,
    /// Texts by version and name.
    definitions: HashMap<(RosVersion, String), String>,
}

/// Names of ROS 1 and those of ROS 2.
#[derive(Debug, Clone)]
struct Names<T> {
    one_to_two: HashMap<T, T>,
    two_to_one: HashMap<T, T>,
}

impl<T> Default for Names<T> {
    fn default() -> Self {
        Names { one_to_two: HashMap::new(), two_to_one: HashMap::new() }
    }
}

impl<T: Clone + Eq + std::hash::Hash> Names<T> {
    fn insert(&mut self, one: T, two: T) {
        self.one_to_two.insert(one.clone(), two.clone());
        self.two_to_one.insert(two, one);
    }

    fn get(&self, from: RosVersion, name: &T) -> Option<&T> {
        match from {
            RosVersion::One => self.one_to_two.get(name),
            RosVersion::Two => self.two_to_one.get(name),
        }
    }
}

/// Pairs of fields, as a rule lists them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct FieldRule {
    /// Place of the rule, for errors: `rules.yaml, rule 3`.
    pub(crate) place: String,
    /// Path in ROS 1, path in ROS 2.
    pub(crate) fields: Vec<(String, String)>,
}

impl Default for TranslationRules {
    fn default() -> Self {
        table::BUILT_IN.clone()
    }
}

impl TranslationRules {
    /// Returns no rules at all.
    fn empty() -> TranslationRules {
        TranslationRules {
            packages: Names::default(),
            messages: Names::default(),
            services: Names::default(),
            fields: HashMap::new(),
            definitions: HashMap::new(),
        }
    }

    /// Adds the rules of a file. They win over the rules so far, and later rules of a file over earlier ones. `file` is
    /// named in errors.
    pub fn with_yaml(mut self, file: &str, yaml: &str) -> Result<TranslationRules, RuleError> {
        let mut rules = yaml::read(file, yaml)?;
        // A rule of a package replaces those of its messages in earlier files, but not those beside it.
        rules.sort_by_key(|rule| rule.about != yaml::About::Packages);
        for rule in rules {
            self.insert(rule);
        }
        Ok(self)
    }

    /// Adds the rules of a file on this machine, as [`with_yaml`](Self::with_yaml) does.
    ///
    /// # Errors
    /// It cannot be read, is too long, or is no list of rules.
    pub fn with_file(self, path: &Path) -> Result<TranslationRules, RuleError> {
        let text = yaml::read_text(path)?;
        self.with_yaml(&path.display().to_string(), &text)
    }

    fn insert(&mut self, rule: yaml::Rule) {
        let yaml::Rule { place, one_package, two_package, about } = rule;
        let mut add_fields = |one: &str, two: &str, fields: Option<Vec<(String, String)>>| {
            let key = (format!("{one_package}/{one}"), format!("{two_package}/{two}"));
            match fields {
                Some(fields) => self.fields.insert(key, FieldRule { place: place.clone(), fields }),
                None => self.fields.remove(&key),
            };
        };
        match about {
            yaml::About::Packages => {
                for names in [&mut self.messages, &mut self.services] {
                    names.one_to_two.retain(|(package, _), _| *package != one_package);
                    names.two_to_one.retain(|(package, _), _| *package != two_package);
                }
                self.packages.insert(one_package, two_package);
            }
            yaml::About::Message { one, two, fields, one_definition, two_definition } => {
                add_fields(&one, &two, fields);
                let definitions = [
                    (RosVersion::One, &one_package, &one, one_definition),
                    (RosVersion::Two, &two_package, &two, two_definition),
                ];
                for (version, package, name, definition) in definitions {
                    let name = write_name(version, package, "msg", name);
                    if let Some(definition) = definition {
                        self.definitions.insert((version, name), definition);
                    }
                }
                self.messages.insert((one_package, one), (two_package, two));
            }
            yaml::About::Service { one, two, request, response } => {
                for (part, fields) in [("Request", request), ("Response", response)] {
                    add_fields(&format!("{one}{part}"), &format!("{two}_{part}"), fields);
                }
                self.services.insert((one_package, one), (two_package, two));
            }
        }
    }

    /// Returns the rule for the fields of two messages, by their names in ROS 1 and ROS 2.
    pub(crate) fn fields(&self, one: &str, two: &str) -> Option<&FieldRule> {
        let two = TypeName::parse(two);
        let key = (one.to_owned(), format!("{}/{}", two.package, two.short));
        self.fields.get(&key)
    }

    /// Returns the definition that a rule gives.
    pub(crate) fn definition(&self, version: RosVersion, name: &str) -> Option<&str> {
        self.definitions.get(&(version, name.to_owned())).map(String::as_str)
    }

    /// Returns the name of a package in the other ROS.
    fn package<'a>(&'a self, from: RosVersion, package: &'a str) -> &'a str {
        self.packages.get(from, &package.to_owned()).map_or(package, String::as_str)
    }

    /// Returns the name of a message in the other ROS.
    pub(crate) fn message_name(&self, name: &str, from: RosVersion) -> String {
        let parsed = TypeName::parse(name);
        let to = from.other();
        if let Some((short, part)) = split_part(parsed).filter(|_| from == RosVersion::Two) {
            let owner = format!("{}/{}/{short}", parsed.package, parsed.kind);
            let owner =
                if parsed.kind == "srv" { self.service_name(&owner, from) } else { self.action_name(&owner, from) };
            return format!("{owner}{part}");
        }
        let key = (parsed.package.to_owned(), parsed.short.to_owned());
        match self.messages.get(from, &key) {
            Some((package, short)) => write_name(to, package, "msg", short),
            None => write_name(to, self.package(from, parsed.package), "msg", parsed.short),
        }
    }

    /// Returns the name of a service in the other ROS.
    pub(crate) fn service_name(&self, name: &str, from: RosVersion) -> String {
        let parsed = TypeName::parse(name);
        let to = from.other();
        let key = (parsed.package.to_owned(), parsed.short.to_owned());
        match self.services.get(from, &key) {
            Some((package, short)) => write_name(to, package, "srv", short),
            None => write_name(to, self.package(from, parsed.package), "srv", parsed.short),
        }
    }

    /// Returns the name of an action in the other ROS.
    pub(crate) fn action_name(&self, name: &str, from: RosVersion) -> String {
        let parsed = TypeName::parse(name);
        let package = self.package(from, parsed.package);
        write_name(from.other(), package, "action", parsed.short)
    }
}

#[cfg(test)]
mod tests;
