//! The interface of a service as robots of the other ROS see it: every type is replaced by its twin there.

use std::collections::BTreeMap;

use ros::bus::RosVersion;
use ros::bus::parameter_names::spell_in_ros1;
use ros::schema::{Base, MessageType, Registry};
use translation::TypeTranslations;

use crate::interface::{Interface, Parameter};
use crate::{Error, names};

impl Interface {
    /// Returns the interface of `service`, which is of this ROS, with the types of the other ROS and their definitions.
    /// Topics of any type (`*`) stay so. QoS and lifecycles exist in ROS 2 alone.
    ///
    /// # Errors
    /// Types have no twin; the error names all of them, with their fields.
    pub fn to_other_ros(
        &self,
        ros: RosVersion,
        service: &str,
        translations: &TypeTranslations,
    ) -> Result<Interface, Error> {
        let registry = Registry::for_version(ros);
        for (key, text) in &self.definitions {
            // An unusable one is a problem only if its type is used.
            let _ = registry.insert(key, text);
        }
        let mut twins =
            TwinInterface { registry, translations, definitions: BTreeMap::new(), problems: BTreeMap::new() };
        let mut other = self.clone();
        for topic in &mut other.topics {
            topic.qos = None;
            if let Some((type_name, digest)) = twins.find_message(&topic.type_name, &topic.name) {
                (topic.type_name, topic.md5) = (type_name, digest);
            }
        }
        for service in &mut other.services {
            if let Some((type_name, digest)) = twins.find_service(&service.type_name, &service.name) {
                (service.type_name, service.md5) = (type_name, digest);
            }
        }
        for action in &mut other.actions {
            if let Some(type_name) = twins.find_action(&action.type_name, &action.name) {
                action.type_name = type_name;
            }
        }
        if !twins.problems.is_empty() {
            let problems = twins.problems.into_iter().map(|(problem, user)| format!("{user}: {problem}")).collect();
            return Err(Error::NoTwins { robot: ros.other().number(), service: service.to_owned(), problems });
        }
        if ros == RosVersion::Two {
            other.lifecycle.clear();
            for parameter in &mut other.parameters {
                share_parameter(parameter);
            }
        }
        other.definitions = twins.definitions;
        Ok(other)
    }
}

/// Renames a node's own parameter as it stands on the Master of a robot of ROS 1.
fn share_parameter(parameter: &mut Parameter) {
    if let Some(own) = parameter.own_name() {
        parameter.name = format!("{}/{}", parameter.node, spell_in_ros1(own));
    }
    parameter.node.clear();
}

/// The types of an interface in the other ROS, as far as they were looked up.
struct TwinInterface<'a> {
    registry: Registry,
    translations: &'a TypeTranslations,
    /// Definitions of the twins, by key.
    definitions: BTreeMap<String, String>,
    /// Problems, and the first topic, service or action with each.
    problems: BTreeMap<String, String>,
}

impl TwinInterface<'_> {
    /// Returns the name and the digest of a message's twin.
    fn find_message(&mut self, type_name: &str, user: &str) -> Option<(String, String)> {
        if type_name == "*" {
            return None;
        }
        let of = self.registry.message(type_name);
        let of = self.keep(of, user)?;
        let twin = self.translations.message(&of);
        let twin = &self.keep(twin, user)?.twin;
        self.add_message(twin);
        Some((twin.name().to_owned(), twin.digest().to_owned()))
    }

    /// Returns the name and the digest of a service's twin.
    fn find_service(&mut self, type_name: &str, user: &str) -> Option<(String, String)> {
        let of = self.registry.service(type_name);
        let of = self.keep(of, user)?;
        let twin = self.translations.service(&of);
        let twin = &self.keep(twin, user)?.twin;
        self.add_sections(&twin.name, "srv", &[&twin.request, &twin.response]);
        Some((twin.name.clone(), twin.md5.clone()))
    }

    /// Returns the name of an action's twin.
    fn find_action(&mut self, type_name: &str, user: &str) -> Option<String> {
        let of = self.registry.action(type_name);
        let of = self.keep(of, user)?;
        let twin = self.translations.action(&of);
        let twin = &self.keep(twin, user)?.twin;
        self.add_sections(&twin.name, "action", &[&twin.goal, &twin.result, &twin.feedback]);
        Some(twin.name.clone())
    }

    /// Returns what was found, or keeps the problem.
    fn keep<T, E: std::fmt::Display>(&mut self, found: Result<T, E>, user: &str) -> Option<T> {
        found.map_err(|error| self.problems.entry(error.to_string()).or_insert_with(|| user.to_owned())).ok()
    }

    fn add_message(&mut self, of: &MessageType) {
        let key = names::definition_key(of.name(), "msg");
        if self.definitions.insert(key, of.text().to_owned()).is_none() {
            self.add_fields(of);
        }
    }

    fn add_fields(&mut self, of: &MessageType) {
        for field in of.fields() {
            if let Base::Message(message) = &field.base {
                self.add_message(message);
            }
        }
    }

    /// Adds the definition of a service or an action, which consists of those of its parts.
    fn add_sections(&mut self, name: &str, kind: &str, parts: &[&MessageType]) {
        let text: Vec<String> = parts.iter().map(|part| section_text(part.text())).collect();
        self.definitions.insert(names::definition_key(name, kind), text.join("---\n"));
        for part in parts {
            self.add_fields(part);
        }
    }
}

/// Returns the text of a part of a service or an action, without the notice that genaction writes above it.
fn section_text(text: &str) -> String {
    let kept = text.lines().filter(|line| !line.starts_with("# ===="));
    kept.map(|line| format!("{line}\n")).collect()
}

#[cfg(test)]
mod tests {
    use translation::TranslationRules;

    use super::*;

    fn interface_of_one() -> Interface {
        serde_json::from_value(serde_json::json!({
            "topics": [
                {"name": "/see/found", "type": "p/Found", "md5": "0", "direction": "output", "latched": true},
                {"name": "/any", "type": "*", "direction": "input"},
            ],
            "services": [{"name": "/see/reset", "type": "p/Reset", "md5": "0", "node": "/see"}],
            "actions": [{"name": "/see/go", "type": "p/Go", "node": "/see"}],
            "definitions": {
                "p/msg/Found": "Header header\ntime first\nPart[] parts\n",
                "p/msg/Part": "float32 score\nchar letter\n",
                "p/srv/Reset": "bool hard\n---\nstring said\n",
                "p/action/Go": "int32 to\n---\nPart best\n---\nduration left\n",
            },
        }))
        .expect("an interface")
    }

    fn translations() -> TypeTranslations {
        TypeTranslations::new(TranslationRules::default())
    }

    #[test]
    fn all_types_are_those_of_the_other_ros() {
        let one = interface_of_one();
        let two = one.to_other_ros(RosVersion::One, "people", &translations()).expect("twins");
        let types = |interface: &Interface| -> Vec<String> {
            let topics = interface.topics.iter().map(|topic| topic.type_name.clone());
            let services = interface.services.iter().map(|service| service.type_name.clone());
            topics.chain(services).chain(interface.actions.iter().map(|action| action.type_name.clone())).collect()
        };
        assert_eq!(types(&two), ["p/msg/Found", "*", "p/srv/Reset", "p/action/Go"]);
        assert!(two.topics[0].md5.starts_with("RIHS01_") && two.topics[0].latched, "{:?}", two.topics);
        for key in ["p/msg/Found", "p/msg/Part", "p/srv/Reset", "p/action/Go", "std_msgs/msg/Header"] {
            assert!(two.definitions.contains_key(key), "{key}: {:?}", two.definitions.keys());
        }
        // The definitions are complete and have the digests that the interface states.
        let registry = Registry::with_definitions(RosVersion::Two, &two.definitions).expect("definitions");
        assert_eq!(registry.message("p/msg/Found").expect("valid").digest(), two.topics[0].md5);
        assert_eq!(registry.service("p/srv/Reset").expect("valid").md5, two.services[0].md5);
        registry.action("p/action/Go").expect("valid");
        // There and back the types are the same.
        let back = two.to_other_ros(RosVersion::Two, "people", &translations()).expect("twins");
        assert_eq!(types(&back), types(&one));
        assert!(back.definitions["p/action/Go"].matches("---\n").count() == 2, "{:?}", back.definitions);
    }

    #[test]
    fn parameters_of_ros_2_stand_at_the_nodes_name() {
        let two: Interface = serde_json::from_value(serde_json::json!({
            "parameters": [{"name": "/arm/see/camera.rate", "node": "/arm/see", "value": 3}],
            "lifecycle": ["/arm/see"],
        }))
        .expect("an interface");
        let one = two.to_other_ros(RosVersion::Two, "people", &translations()).expect("twins");
        assert_eq!((&*one.parameters[0].name, &*one.parameters[0].node), ("/arm/see/camera/rate", ""));
        assert!(one.lifecycle.is_empty());
    }

    #[test]
    fn every_type_without_a_twin_is_named() {
        let mut one = interface_of_one();
        one.definitions.remove("p/srv/Reset");
        // Two fields that ROS 2, where names are in lower case, could not tell apart.
        one.definitions.insert("p/msg/Part".into(), "float32 score\nfloat32 Score\n".into());
        let error = one.to_other_ros(RosVersion::One, "people", &translations()).expect_err("no twins").to_string();
        let named = ["robots of ROS 2 cannot use people", "/see/found: ", "/see/reset: ", "p/Reset", "Score"];
        assert!(named.iter().all(|word| error.contains(word)), "{error}");
    }
}
