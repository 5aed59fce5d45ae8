//! Interfaces as TOML: the supplement of a deployer, and the `interface.toml` of a stub.

use std::fmt::Display;
use std::path::Path;

use serde_json::Value;

use crate::interface::Interface;
use crate::{Error, names};

/// Keys allowed in each table of a file.
const KEYS: [(&str, &[&str]); 7] = [
    ("topics", &["name", "type", "md5", "direction", "nodes", "latched", "lazy", "qos"]),
    ("services", &["name", "type", "md5", "node"]),
    ("actions", &["name", "type", "node"]),
    ("parameters", &["name", "node", "value", "read_by", "written_by", "descriptor"]),
    ("needs", &["name", "nodes"]),
    ("lifecycle", &[]),
    ("late", &[]),
];

impl Interface {
    /// Returns the text of an `interface.toml`, without request pairs. TOML has no null: null members and elements are
    /// left out.
    pub fn to_toml(&self) -> String {
        let mut writable = self.clone();
        // Request pairs are decided by the push and cannot be stated here.
        writable.requests = None;
        for parameter in &mut writable.parameters {
            parameter.value = parameter.value.take().and_then(remove_nulls);
        }
        toml::to_string_pretty(&writable).expect("an interface without nulls is TOML")
    }

    /// Parses the text of a file; `path` is used in messages. A supplement needs only names, types and the directions
    /// of topics:
    ///
    /// ```toml
    /// [[topics]]
    /// name = "/image"
    /// type = "sensor_msgs/Image"
    /// direction = "input"        # the package subscribes
    /// ```
    pub fn from_toml(text: &str, path: &Path) -> Result<Self, Error> {
        let failed = |error: &toml::de::Error| parse_error(text, path, error.span(), error.message());
        // First as a generic table, to detect misspelled keys.
        let table: toml::Table = toml::from_str(text).map_err(|error| failed(&error))?;
        if let Some((key, problem)) = find_unknown_key(&table) {
            let at = text.find(key).map(|start| start..start + key.len());
            return Err(parse_error(text, path, at, problem));
        }
        let interface: Self = toml::from_str(text).map_err(|error| failed(&error))?;
        if let Some((name, problem)) = interface.find_invalid_name() {
            let at = text.find(name).map(|start| start..start + name.len());
            return Err(parse_error(text, path, at, problem));
        }
        Ok(interface)
    }

    /// Returns an invalid name or type, and the reason.
    fn find_invalid_name(&self) -> Option<(&str, String)> {
        let named = self.topics.iter().map(|topic| (&topic.name, Some(&topic.type_name)));
        let named = named.chain(self.services.iter().map(|service| (&service.name, Some(&service.type_name))));
        let named = named.chain(self.actions.iter().map(|action| (&action.name, Some(&action.type_name))));
        // The name of a node's own parameter is not a graph name: `/see/qos.depth`.
        let shared =
            self.parameters.iter().filter(|parameter| parameter.own_name().is_none_or(|own| !is_own_name(own)));
        let named = named.chain(shared.map(|parameter| (&parameter.name, None)));
        let owners = self.parameters.iter().filter(|parameter| !parameter.node.is_empty());
        let named = named.chain(owners.map(|parameter| (&parameter.node, None)));
        let named = named.chain(self.lifecycle.iter().map(|node| (node, None)));
        let mut named = named.chain(self.needs.iter().map(|need| (&need.name, None)));
        named.find_map(|(name, of_type)| {
            if !names::is_graph_name(name) {
                return Some((name.as_str(), format!("{name:?} is not an absolute name such as \"/camera/image\"")));
            }
            // Some nodes accept any type, such as relays.
            let fits = |of_type: &str| of_type == "*" || names::is_full_type(of_type);
            let bad = of_type.filter(|of_type| !fits(of_type))?;
            Some((bad.as_str(), format!("{bad:?} is not a type such as \"sensor_msgs/Image\"")))
        })
    }
}

/// Returns whether a name is valid for a node's own parameter.
fn is_own_name(name: &str) -> bool {
    (1..=512).contains(&name.len()) && !name.chars().any(|c| c.is_control() || c.is_whitespace())
}

fn remove_nulls(value: Value) -> Option<Value> {
    Some(match value {
        Value::Null => return None,
        Value::Array(items) => items.into_iter().filter_map(remove_nulls).collect(),
        Value::Object(members) => {
            let kept = members.into_iter().filter_map(|(key, value)| Some((key, remove_nulls(value)?)));
            Value::Object(kept.collect())
        }
        // TOML integers are signed.
        Value::Number(number) if number.as_i64().is_none() => number.as_f64()?.into(),
        other => other,
    })
}

/// Returns a key that is not allowed, and a message with those that are.
fn find_unknown_key(table: &toml::Table) -> Option<(&str, String)> {
    for (section, content) in table {
        if section == "definitions" {
            continue;
        }
        let Some((_, keys)) = KEYS.iter().find(|(known, _)| known == section) else {
            let known = KEYS.map(|(known, _)| known).join(", ");
            return Some((section, format!("unknown section {section:?}; the sections are {known} and definitions")));
        };
        let entries = content.as_array().into_iter().flatten().filter_map(toml::Value::as_table);
        for key in entries.flat_map(toml::Table::keys) {
            if !keys.contains(&key.as_str()) {
                return Some((key, format!("unknown key {key:?} in {section}; the keys are {}", keys.join(", "))));
            }
        }
    }
    None
}

fn parse_error(text: &str, path: &Path, span: Option<std::ops::Range<usize>>, problem: impl Display) -> Error {
    let before = text.get(..span.map_or(0, |span| span.start)).unwrap_or_default();
    let line_start = before.rfind('\n').map_or(0, |newline| newline + 1);
    Error::Interface {
        path: path.to_owned(),
        line: before.matches('\n').count() + 1,
        column: before[line_start..].chars().count() + 1,
        problem: problem.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::interface::{Descriptor, Direction, Durability, Need, Parameter, Qos, Range, Topic};

    fn parse(text: &str) -> Result<Interface, Error> {
        Interface::from_toml(text, Path::new("x.toml"))
    }

    const SUPPLEMENT: &str = r#"
[[topics]]
name = "/image"
type = "sensor_msgs/Image"
direction = "input"

[[services]]
name = "/reset"
type = "std_srvs/Empty"

[[actions]]
name = "/go"
type = "demo/Go"

[[parameters]]
name = "/threshold"
value = 0.5

[definitions]
"demo/action/Go" = "int32 x\n---\n---\n"
"#;

    #[test]
    fn a_supplement_says_only_what_is_needed() {
        let interface = parse(SUPPLEMENT).unwrap();
        assert_eq!(interface.topics[0].direction, Direction::Input);
        assert_eq!((&interface.topics[0].md5[..], interface.topics[0].nodes.len()), ("", 0));
        assert_eq!(interface.services[0].type_name, "std_srvs/Empty");
        assert_eq!(interface.parameters[0].value, Some(0.5.into()));
        assert_eq!(parse("").unwrap(), Interface::default());
    }

    #[test]
    fn what_is_written_is_read() {
        let mut interface = parse(SUPPLEMENT).unwrap();
        interface.topics[0].nodes = vec!["/n".into()];
        interface.topics[0].latched = true;
        interface.late = vec!["/go".into()];
        // A relay accepts any type.
        let any = Topic { name: "/any".into(), type_name: "*".into(), md5: "*".into(), ..interface.topics[0].clone() };
        interface.topics.push(any);
        interface.definitions.insert("a/msg/B".into(), "# \"\"\" ''' \\ \n\tint32 x\r\n".into());
        interface.parameters[0].value = Some(serde_json::json!({"a": [1, "x", {"b": true}], "c d/e": 1.5}));
        interface.parameters.push(Parameter {
            name: "/asked".into(),
            value: None,
            read_by: vec!["/n".into()],
            ..Parameter::default()
        });
        // Additions of ROS 2.
        interface.topics[0].qos =
            Some(Qos { durability: Durability::TransientLocal, deadline: Some(0.5), ..Qos::default() });
        interface.lifecycle = vec!["/n".into()];
        interface.parameters.push(Parameter {
            name: "/n/camera.rate".into(),
            node: "/n".into(),
            value: Some(serde_json::json!([1, 2])),
            descriptor: Some(Descriptor {
                kind: "integer_array".into(),
                read_only: true,
                range: Some(Range { from: Some(0.into()), ..Range::default() }),
                ..Descriptor::default()
            }),
            ..Parameter::default()
        });
        assert_eq!(interface.parameters[2].own_name(), Some("camera.rate"));
        interface.needs.push(Need { name: "/static_map".into(), nodes: vec!["/n".into()] });
        assert_eq!(parse(&interface.to_toml()).unwrap(), interface);
    }

    #[test]
    fn values_that_toml_has_not_are_left_out_or_made_to_fit() {
        let mut interface = parse(SUPPLEMENT).unwrap();
        interface.parameters[0].value = Some(serde_json::json!({"n": null, "a": [null, 1], "big": u64::MAX}));
        let read = parse(&interface.to_toml()).unwrap();
        assert_eq!(read.parameters[0].value, Some(serde_json::json!({"a": [1], "big": u64::MAX as f64})));
        interface.parameters[0].value = Some(Value::Null);
        assert_eq!(parse(&interface.to_toml()).unwrap().parameters[0].value, None);
    }

    #[test]
    fn a_bad_file_is_told_with_its_place() {
        let topic = |rest: &str| format!("[[topics]]\nname = \"/a\"\n{rest}");
        for (text, reason) in [
            ("[[topics]]\nname = ".to_owned(), "x.toml, line 2, column "),
            (topic("type = \"a/B\""), "missing field `direction`"),
            (topic("type = \"a/B\"\ndirection = \"sideways\""), "line 4, column 13: unknown variant `sideways`"),
            (
                topic("typ = \"a/B\"\ndirection = \"input\""),
                "line 3, column 1: unknown key \"typ\" in topics; the keys are name, type",
            ),
            (topic("type = \"B\"\ndirection = \"input\""), "line 3, column 9: \"B\" is not a type such as"),
            ("[[parameters]]\nname = \"a\"".to_owned(), "\"a\" is not an absolute name"),
            ("[[parameters]]\nname = \"/n/a b\"\nnode = \"/n\"".to_owned(), "\"/n/a b\" is not an absolute name"),
            ("lifecycle = [\"n\"]".to_owned(), "\"n\" is not an absolute name"),
            ("[[topic]]\nname = \"a\"".to_owned(), "unknown section \"topic\"; the sections are topics, services"),
        ] {
            let message = parse(&text).unwrap_err().to_string();
            assert!(message.contains(reason), "{reason:?} is not in: {message}");
        }
    }
}
