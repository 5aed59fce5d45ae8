//! `--interface FILE`: additions to the interface, where the push cannot find all of it.
//!
//! ```toml
//! [[topics]]
//! name = "/map"
//! type = "nav_msgs/OccupancyGrid"
//! direction = "output"
//! latched = true
//! [[services]]
//! name = "/save"
//! type = "std_srvs/Trigger"
//! ```

use std::collections::BTreeMap;
use std::path::Path;

use package::interface::Interface;
use package::names;
use ros::bus::RosVersion;
use ros::schema::{Base, MessageType, Registry, SchemaError};

/// Errors of an interface supplement.
#[derive(Debug, thiserror::Error)]
pub enum SupplementError {
    /// Neither valid TOML nor valid JSON.
    #[error("{0}")]
    Unreadable(String),
    /// Contradicts the interface that was found.
    #[error("{0}")]
    Contradiction(String),
    /// The name is not absolute.
    #[error("{0:?} is not an absolute name; begin it with /")]
    Relative(String),
    /// The type is not defined in the image.
    #[error("{name}: {source}; add the Debian package of this type with --with")]
    Type {
        /// Name of the object with the type.
        name: String,
        /// Missing definition.
        source: SchemaError,
    },
}

/// Adds the supplement `text` to `interface`. Entries that were found by the push are kept.
pub(super) fn add(
    interface: &mut Interface,
    text: &str,
    (ros, definitions): (RosVersion, &BTreeMap<String, String>),
) -> Result<(), SupplementError> {
    let mut stated = read(text)?;
    let registry = Registry::with_definitions(ros, definitions).map_err(unknown_type("the image"))?;
    let mut texts = UsedDefinitions { definitions, used: BTreeMap::new() };
    for topic in &mut stated.topics {
        check_absolute(&topic.name)?;
        let message = registry.message(&topic.type_name).map_err(unknown_type(&topic.name))?;
        texts.add_message(&message);
        // A type may be stated with or without its kind; each ROS version has one canonical form.
        topic.type_name = message.name().to_owned();
        topic.md5 = message.digest().to_owned();
    }
    for service in &mut stated.services {
        check_absolute(&service.name)?;
        let definition = registry.service(&service.type_name).map_err(unknown_type(&service.name))?;
        texts.add_definition(&service.type_name, "srv");
        texts.add_message(&definition.request);
        texts.add_message(&definition.response);
        service.type_name.clone_from(&definition.name);
        service.md5.clone_from(&definition.md5);
    }
    for action in &mut stated.actions {
        check_absolute(&action.name)?;
        let definition = registry.action(&action.type_name).map_err(unknown_type(&action.name))?;
        texts.add_definition(&action.type_name, "action");
        for message in [&definition.goal, &definition.result, &definition.feedback] {
            texts.add_message(message);
        }
        action.type_name.clone_from(&definition.name);
    }
    for parameter in &stated.parameters {
        check_absolute(&parameter.name)?;
    }
    stated.definitions = texts.used;
    interface.supplement(&stated).map_err(|error| SupplementError::Contradiction(error.to_string()))
}

/// Returns the topics and their types, as far as the text can be parsed; errors are reported when it is added.
pub(super) fn topic_types(text: &str) -> BTreeMap<String, String> {
    let topics = read(text).unwrap_or_default().topics.into_iter();
    topics.map(|topic| (topic.name, topic.type_name)).collect()
}

fn read(text: &str) -> Result<Interface, SupplementError> {
    if text.trim_start().starts_with('{') {
        return serde_json::from_str(text).map_err(|error| SupplementError::Unreadable(error.to_string()));
    }
    Interface::from_toml(text, Path::new("the file")).map_err(|error| SupplementError::Unreadable(error.to_string()))
}

fn check_absolute(name: &str) -> Result<(), SupplementError> {
    if name.starts_with('/') && name.len() > 1 { Ok(()) } else { Err(SupplementError::Relative(name.to_owned())) }
}

fn unknown_type(name: &str) -> impl FnOnce(SchemaError) -> SupplementError {
    let name = name.to_owned();
    move |source| SupplementError::Type { name, source }
}

/// Collects the definitions that are used, with all that they refer to.
struct UsedDefinitions<'a> {
    definitions: &'a BTreeMap<String, String>,
    used: BTreeMap<String, String>,
}

impl UsedDefinitions<'_> {
    fn add_definition(&mut self, type_name: &str, kind: &str) -> bool {
        let key = names::definition_key(type_name, kind);
        match self.definitions.get(&key) {
            Some(text) => self.used.insert(key, text.clone()).is_none(),
            None => false,
        }
    }

    fn add_message(&mut self, message: &MessageType) {
        self.add_definition(message.name(), "msg");
        for field in message.fields() {
            if let Base::Message(inner) = &field.base {
                self.add_message(inner);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn definitions() -> BTreeMap<String, String> {
        let texts =
            [("a/msg/Outer", "Inner inner\n"), ("a/msg/Inner", "string text\n"), ("a/srv/Ask", "---\nInner answer\n")];
        texts.map(|(key, text)| (key.to_owned(), text.to_owned())).into()
    }

    #[test]
    fn what_was_not_found_is_added_with_its_definitions() {
        let mut interface = Interface::default();
        let text = "[[topics]]\nname = \"/out\"\ntype = \"a/Outer\"\ndirection = \"output\"\n\
                    [[services]]\nname = \"/ask\"\ntype = \"a/Ask\"\n";
        add(&mut interface, text, (RosVersion::One, &definitions())).expect("valid");
        assert_eq!(interface.topics[0].name, "/out");
        assert_eq!(interface.topics[0].md5.len(), 32);
        assert_eq!(interface.services[0].type_name, "a/Ask");
        let keys: Vec<&str> = interface.definitions.keys().map(String::as_str).collect();
        assert_eq!(keys, ["a/msg/Inner", "a/msg/Outer", "a/srv/Ask"]);
    }

    #[test]
    fn types_of_ros_2_are_stated_with_their_kind_or_without() {
        let text = "[[topics]]\nname = \"/out\"\ntype = \"a/Outer\"\ndirection = \"output\"\n\
                    [[services]]\nname = \"/ask\"\ntype = \"a/srv/Ask\"\n\
                    [[actions]]\nname = \"/go\"\ntype = \"a/Go\"\n";
        let mut definitions = definitions();
        let go = "Inner to\n---\n---\n".to_owned();
        definitions.insert("a/action/Go".to_owned(), go);
        let mut interface = Interface::default();
        add(&mut interface, text, (RosVersion::Two, &definitions)).expect("valid");
        assert_eq!(interface.topics[0].type_name, "a/msg/Outer");
        assert!(interface.topics[0].md5.starts_with("RIHS01_"));
        assert_eq!(interface.services[0].type_name, "a/srv/Ask");
        assert_eq!(interface.actions[0].type_name, "a/action/Go");
        let keys: Vec<&str> = interface.definitions.keys().map(String::as_str).collect();
        assert_eq!(keys, ["a/action/Go", "a/msg/Inner", "a/msg/Outer", "a/srv/Ask"]);
    }

    #[test]
    fn json_is_read_too_and_what_was_found_stays() {
        let mut interface = Interface::default();
        let text = r#"{"topics": [{"name": "/out", "type": "a/Inner", "direction": "output", "latched": true}]}"#;
        add(&mut interface, text, (RosVersion::One, &definitions())).expect("valid");
        let before = interface.clone();
        add(&mut interface, &text.replace("true", "false"), (RosVersion::One, &definitions())).expect("valid");
        assert_eq!(interface, before);
    }

    #[test]
    fn mistakes_are_named() {
        for (text, words) in [
            (
                "[[topics]]\nname = \"out\"\ntype = \"a/Inner\"\ndirection = \"output\"",
                "\"out\" is not an absolute name",
            ),
            ("[[topics]]\nname = \"/out\"\ntype = \"b/None\"\ndirection = \"output\"", "b/None"),
            ("[[topics]]\nname = \"/out\"\ntyp = \"a/Inner\"", "typ"),
            ("{", "EOF"),
        ] {
            let refused =
                add(&mut Interface::default(), text, (RosVersion::One, &definitions())).expect_err(words).to_string();
            assert!(refused.contains(words), "{refused}");
        }
    }
}
