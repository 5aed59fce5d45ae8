//! Supplements: additions by the deployer to the interface found in the running package.

use std::fmt::Display;

use crate::Error;
use crate::interface::{Action, Direction, Interface, Parameter, Service, Topic};

impl Interface {
    /// Adds the deployer's entries to what was found in the running package. What was found takes precedence; a
    /// contradicting type or definition is an error, and then nothing is changed.
    pub fn supplement(&mut self, stated: &Self) -> Result<(), Error> {
        let mut merged = self.clone();
        for topic in &stated.topics {
            merged.add_topic(topic)?;
        }
        for service in &stated.services {
            merged.add_service(service)?;
        }
        for action in &stated.actions {
            merged.add_action(action)?;
        }
        for parameter in &stated.parameters {
            merged.add_parameter(parameter);
        }
        merge_names(&mut merged.lifecycle, &stated.lifecycle);
        for (key, text) in &stated.definitions {
            match merged.definitions.get(key) {
                Some(found) if found.trim() != text.trim() => {
                    return Err(contradiction_error(
                        format!("the definition of {key}"),
                        "a different one",
                        "that of the image",
                    ));
                }
                Some(_) => {}
                None => {
                    merged.definitions.insert(key.clone(), text.clone());
                }
            }
        }
        merged.sort();
        *self = merged;
        Ok(())
    }

    /// Sorts by name, so that equal interfaces have equal texts.
    pub fn sort(&mut self) {
        let direction = |topic: &Topic| matches!(topic.direction, Direction::Output);
        self.topics.sort_by(|a, b| (&a.name, direction(a)).cmp(&(&b.name, direction(b))));
        self.services.sort_by(|a, b| a.name.cmp(&b.name));
        self.actions.sort_by(|a, b| a.name.cmp(&b.name));
        self.parameters.sort_by(|a, b| a.name.cmp(&b.name));
    }

    fn add_topic(&mut self, stated: &Topic) -> Result<(), Error> {
        let same = |topic: &&mut Topic| topic.name == stated.name && topic.direction == stated.direction;
        let Some(found) = self.topics.iter_mut().find(same) else {
            self.topics.push(stated.clone());
            return Ok(());
        };
        let what = || format!("topic {}", stated.name);
        fill_in(what, &stated.type_name, &mut found.type_name)?;
        fill_in(|| format!("the md5 of topic {}", stated.name), &stated.md5, &mut found.md5)?;
        found.latched |= stated.latched;
        found.lazy |= stated.lazy;
        found.qos = found.qos.or(stated.qos);
        merge_names(&mut found.nodes, &stated.nodes);
        Ok(())
    }

    fn add_service(&mut self, stated: &Service) -> Result<(), Error> {
        let Some(found) = self.services.iter_mut().find(|service| service.name == stated.name) else {
            self.services.push(stated.clone());
            return Ok(());
        };
        fill_in(|| format!("service {}", stated.name), &stated.type_name, &mut found.type_name)?;
        fill_in(|| format!("the md5 of service {}", stated.name), &stated.md5, &mut found.md5)
    }

    fn add_action(&mut self, stated: &Action) -> Result<(), Error> {
        let Some(found) = self.actions.iter_mut().find(|action| action.name == stated.name) else {
            self.actions.push(stated.clone());
            return Ok(());
        };
        fill_in(|| format!("action {}", stated.name), &stated.type_name, &mut found.type_name)
    }

    fn add_parameter(&mut self, stated: &Parameter) {
        match self.parameters.iter_mut().find(|parameter| parameter.name == stated.name) {
            Some(found) => {
                found.value = found.value.take().or_else(|| stated.value.clone());
                merge_names(&mut found.read_by, &stated.read_by);
                merge_names(&mut found.written_by, &stated.written_by);
                let said = found.descriptor.take();
                found.descriptor = said.or_else(|| stated.descriptor.clone());
            }
            None => self.parameters.push(stated.clone()),
        }
    }
}

/// Fills in an unknown value; a known one must be equal.
fn fill_in(what: impl Fn() -> String, stated: &str, found: &mut String) -> Result<(), Error> {
    // A node that accepts any type announces `*`; the deployer knows the type that is used.
    if found.is_empty() || (found == "*" && !stated.is_empty()) {
        stated.clone_into(found);
    }
    if stated.is_empty() || stated == found { Ok(()) } else { Err(contradiction_error(what(), stated, found)) }
}

fn contradiction_error(what: String, stated: impl Display, found: impl Display) -> Error {
    Error::Contradiction { what, stated: stated.to_string(), found: found.to_string() }
}

fn merge_names(found: &mut Vec<String>, stated: &[String]) {
    found.extend(stated.iter().cloned());
    found.sort();
    found.dedup();
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn stated_interface() -> Interface {
        let text = r#"
            topics = [{ name = "/image", type = "sensor_msgs/Image", direction = "input" }]
            services = [{ name = "/reset", type = "std_srvs/Empty" }]
            actions = [{ name = "/go", type = "demo/Go" }]
            parameters = [{ name = "/threshold", value = 0.5 }]
            definitions = { "demo/action/Go" = "int32 x" }
        "#;
        Interface::from_toml(text, Path::new("x.toml")).unwrap()
    }

    #[test]
    fn a_stated_type_takes_the_place_of_any() {
        let mut found = Interface::default();
        let mut any = stated_interface().topics.remove(0);
        (any.type_name, any.md5) = ("*".into(), "*".into());
        found.topics.push(any);
        found.supplement(&stated_interface()).unwrap();
        assert_eq!(found.topics[0].type_name, "sensor_msgs/Image");
    }

    #[test]
    fn a_supplement_adds_and_fills_in() {
        let mut found = Interface::default();
        found.topics.push(Topic {
            name: "/image".into(),
            type_name: "sensor_msgs/Image".into(),
            md5: "060021388200f6f0f447d0fcd9c64743".into(),
            direction: Direction::Input,
            nodes: vec!["/n".into()],
            latched: false,
            lazy: true,
            qos: None,
        });
        found.parameters.push(Parameter {
            name: "/threshold".into(),
            value: Some(0.9.into()),
            read_by: vec!["/n".into()],
            ..Parameter::default()
        });
        let mut stated = stated_interface();
        stated.topics.push(Topic { direction: Direction::Output, ..stated.topics[0].clone() });
        found.supplement(&stated).unwrap();
        assert_eq!(found.topics.len(), 2);
        assert!(found.topics[0].lazy && found.topics[0].md5.starts_with("0600"));
        assert_eq!((found.services.len(), found.actions.len(), found.definitions.len()), (1, 1, 1));
        assert_eq!(found.parameters[0].value, Some(0.9.into()), "what was found stands");
        let once = found.clone();
        found.supplement(&stated).unwrap();
        assert_eq!(found, once);
    }

    #[test]
    fn a_contradiction_is_refused_and_changes_nothing() {
        let found = stated_interface();
        let change = |change: fn(&mut Interface)| {
            let mut stated = found.clone();
            change(&mut stated);
            let mut merged = found.clone();
            let text = merged.supplement(&stated).unwrap_err().to_string();
            assert_eq!(merged, found);
            text
        };
        let text = change(|stated| stated.topics[0].type_name = "std_msgs/String".into());
        assert!(text.contains("topic /image is std_msgs/String, but sensor_msgs/Image was found"), "{text}");
        assert!(change(|stated| stated.services[0].type_name = "a/B".into()).contains("service /reset is a/B"));
        assert!(change(|stated| stated.actions[0].type_name = "a/B".into()).contains("action /go is a/B"));
        let text = change(|stated| _ = stated.definitions.insert("demo/action/Go".into(), "int64 x".into()));
        assert!(text.contains("the definition of demo/action/Go"), "{text}");
    }
}
