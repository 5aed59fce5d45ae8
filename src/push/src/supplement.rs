//! `--interface FILE`: what to add to the interface, where the push cannot find all of it.
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

/// Why a supplement is refused.
#[derive(Debug, thiserror::Error)]
pub(super) enum SupplementError {
    /// Neither TOML nor JSON of this form.
    #[error("{0}")]
    Unreadable(String),
    /// What was found says otherwise.
    #[error("{0}")]
    Contradiction(String),
    /// Not an absolute name.
    #[error("{0:?} is not an absolute name; begin it with /")]
    Relative(String),
    /// A type that the image does not hold.
    #[error("{name}: {source}; add the Debian package that holds the type with --with")]
    Type {
        /// What has the type.
        name: String,
        /// What is missing.
        source: SchemaError,
    },
}

/// Adds the supplement `text` to `interface`. What was found stays as it was found.
pub(super) fn add(
    interface: &mut Interface,
    text: &str,
    (ros, definitions): (RosVersion, &BTreeMap<String, String>),
) -> Result<(), SupplementError> {
    let mut stated = read(text)?;
    let registry = Registry::of_definitions(ros, definitions).map_err(unknown("the image"))?;
    let mut texts = Texts {
        definitions,
        used: BTreeMap::new(),
    };
    for topic in &mut stated.topics {
        absolute(&topic.name)?;
        let message = registry
            .message(&topic.type_name)
            .map_err(unknown(&topic.name))?;
        texts.message(&message);
        // A type may be stated with its kind or without; each ROS has one way to write it.
        topic.type_name = message.name().to_owned();
        topic.md5 = message.digest().to_owned();
    }
    for service in &mut stated.services {
        absolute(&service.name)?;
        let definition = registry
            .service(&service.type_name)
            .map_err(unknown(&service.name))?;
        texts.own(&service.type_name, "srv");
        texts.message(&definition.request);
        texts.message(&definition.response);
        service.type_name.clone_from(&definition.name);
        service.md5.clone_from(&definition.md5);
    }
    for action in &mut stated.actions {
        absolute(&action.name)?;
        let definition = registry
            .action(&action.type_name)
            .map_err(unknown(&action.name))?;
        texts.own(&action.type_name, "action");
        for message in [&definition.goal, &definition.result, &definition.feedback] {
            texts.message(message);
        }
        action.type_name.clone_from(&definition.name);
    }
    for parameter in &stated.parameters {
        absolute(&parameter.name)?;
    }
    stated.definitions = texts.used;
    interface
        .supplement(&stated)
        .map_err(|error| SupplementError::Contradiction(error.to_string()))
}

/// Topics and their types, as far as the text can be read: what is wrong with it is said when it is added.
pub(super) fn topic_types(text: &str) -> BTreeMap<String, String> {
    let topics = read(text).unwrap_or_default().topics.into_iter();
    topics.map(|topic| (topic.name, topic.type_name)).collect()
}

fn read(text: &str) -> Result<Interface, SupplementError> {
    if text.trim_start().starts_with('{') {
        return serde_json::from_str(text)
            .map_err(|error| SupplementError::Unreadable(error.to_string()));
    }
    Interface::from_toml(text, Path::new("the file"))
        .map_err(|error| SupplementError::Unreadable(error.to_string()))
}

fn absolute(name: &str) -> Result<(), SupplementError> {
    if name.starts_with('/') && name.len() > 1 {
        Ok(())
    } else {
        Err(SupplementError::Relative(name.to_owned()))
    }
}

fn unknown(name: &str) -> impl FnOnce(SchemaError) -> SupplementError {
    let name = name.to_owned();
    move |source| SupplementError::Type { name, source }
}

/// The definitions that are used, with all that they refer to.
struct Texts<'a> {
    definitions: &'a BTreeMap<String, String>,
    used: BTreeMap<String, String>,
}

impl Texts<'_> {
    fn own(&mut self, type_name: &str, kind: &str) -> bool {
        let key = names::key(type_name, kind);
        match self.definitions.get(&key) {
            Some(text) => self.used.insert(key, text.clone()).is_none(),
            None => false,
        }
    }

    fn message(&mut self, message: &MessageType) {
        self.own(message.name(), "msg");
        for field in message.fields() {
            if let Base::Message(inner) = &field.base {
                self.message(inner);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn definitions() -> BTreeMap<String, String> {
        let texts = [
            ("a/msg/Outer", "Inner inner\n"),
            ("a/msg/Inner", "string text\n"),
            ("a/srv/Ask", "---\nInner answer\n"),
        ];
        texts
            .map(|(key, text)| (key.to_owned(), text.to_owned()))
            .into()
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
        assert_eq!(
            keys,
            ["a/action/Go", "a/msg/Inner", "a/msg/Outer", "a/srv/Ask"]
        );
    }

    #[test]
    fn json_is_read_too_and_what_was_found_stays() {
        let mut interface = Interface::default();
        let text = r#"{"topics": [{"name": "/out", "type": "a/Inner", "direction": "output", "latched": true}]}"#;
        add(&mut interface, text, (RosVersion::One, &definitions())).expect("valid");
        let before = interface.clone();
        add(
            &mut interface,
            &text.replace("true", "false"),
            (RosVersion::One, &definitions()),
        )
        .expect("valid");
        assert_eq!(interface, before);
    }

    #[test]
    fn mistakes_are_named() {
        for (text, words) in [
            (
                "[[topics]]\nname = \"out\"\ntype = \"a/Inner\"\ndirection = \"output\"",
                "\"out\" is not an absolute name",
            ),
            (
                "[[topics]]\nname = \"/out\"\ntype = \"b/None\"\ndirection = \"output\"",
                "b/None",
            ),
            ("[[topics]]\nname = \"/out\"\ntyp = \"a/Inner\"", "typ"),
            ("{", "EOF"),
        ] {
            let refused = add(
                &mut Interface::default(),
                text,
                (RosVersion::One, &definitions()),
            )
            .expect_err(words)
            .to_string();
            assert!(refused.contains(words), "{refused}");
        }
    }
}
