//! Derives definitions of one ROS from types of the other.

use std::collections::{HashMap, HashSet};

use ros_message::RosVersion;
use ros_message::schema::{Arity, Constant, MessageType, Primitive, Registry, SchemaError};

use crate::error::NoTwinReason;
use crate::names::{TypeName, lower_name};
use crate::pairing::{find_path, stamp_of_message};
use crate::rules::{FieldRule, TranslationRules};
use crate::shape::{Slot, SlotBase};
use crate::stamp::Stamp;

/// Maximum number of definitions that are added because a given one mentions them.
const MAX_MENTIONED: usize = 64;

/// Definitions of one ROS, collected for one type of the other.
pub(crate) struct Derivation<'a> {
    rules: &'a TranslationRules,
    /// Definitions that win over derived ones.
    known: Option<&'a Registry>,
    to: RosVersion,
    /// Returns the name of a message's twin.
    name_of: &'a dyn Fn(&MessageType) -> String,
    /// The definitions collected so far.
    registry: Registry,
    /// Names of the types whose twins are in `registry`.
    done: HashSet<String>,
}

impl<'a> Derivation<'a> {
    pub(crate) fn new(
        rules: &'a TranslationRules,
        known: Option<&'a Registry>,
        to: RosVersion,
        name_of: &'a dyn Fn(&MessageType) -> String,
    ) -> Derivation<'a> {
        Derivation { rules, known, to, name_of, registry: Registry::for_version(to), done: HashSet::new() }
    }

    /// Adds the twin of a message, called `twin`, with all messages in it.
    pub(crate) fn add_message(&mut self, original: &MessageType, twin: &str) -> Result<(), NoTwinReason> {
        if !self.done.insert(original.name().to_owned()) {
            return Ok(());
        }
        if self.add_given(twin)? {
            // It mentions the twins of most messages in it.
            return original.fields().iter().try_for_each(|field| self.type_of(&Slot::from_field(field)).map(drop));
        }
        // What every system of a ROS version has.
        if self.registry.message(twin).is_ok() {
            return Ok(());
        }
        let text = self.text(original, twin)?;
        self.registry.insert(twin, &text).map_err(NoTwinReason::Definition)
    }

    /// Adds a definition that is known or that a rule gives; returns false if there is none.
    fn add_given(&mut self, twin: &str) -> Result<bool, NoTwinReason> {
        let known = self.known.map(|known| known.message(twin));
        let added = match (known, self.rules.definition(self.to, twin)) {
            (Some(Ok(known)), _) => self.registry.insert_full_text(twin, known.full_text()),
            (Some(Err(error)), _) if !matches!(error, SchemaError::Unknown(_)) => Err(error),
            (_, Some(text)) => self.registry.insert(twin, text),
            (_, None) => return Ok(false),
        };
        added.map_err(NoTwinReason::Definition)?;
        Ok(true)
    }

    /// Adds a service or action, called `key`, made of these parts.
    pub(crate) fn add_parts(&mut self, key: &str, parts: &[(&MessageType, String)]) -> Result<(), NoTwinReason> {
        let mut sections = Vec::new();
        for (part, twin) in parts {
            sections.push(self.text(part, twin)?);
        }
        self.registry.insert(key, &sections.join("---\n")).map_err(NoTwinReason::Definition)
    }

    /// Resolves what was collected. A definition that is given, not derived, may mention messages that the original
    /// does not have; those are given too.
    pub(crate) fn resolve<T>(&mut self, find: impl Fn(&Registry) -> Result<T, SchemaError>) -> Result<T, NoTwinReason> {
        for _ in 0..MAX_MENTIONED {
            match find(&self.registry) {
                Err(SchemaError::Missing { name, needed_by }) => {
                    if !self.add_given(&name)? {
                        return Err(NoTwinReason::Definition(SchemaError::Missing { name, needed_by }));
                    }
                }
                found => return found.map_err(NoTwinReason::Definition),
            }
        }
        find(&self.registry).map_err(NoTwinReason::Definition)
    }

    /// Returns the text of the twin of a message, and adds the twins of the messages in it.
    fn text(&mut self, original: &MessageType, twin: &str) -> Result<String, NoTwinReason> {
        let mut text = String::new();
        for constant in original.constants() {
            text.extend(constant_line(constant, self.to));
        }
        let rules = self.rules;
        let rule = match self.to {
            RosVersion::One => rules.fields(twin, original.name()),
            RosVersion::Two => rules.fields(original.name(), twin),
        };
        match rule {
            None => {
                let mut names = HashMap::new();
                for field in original.fields() {
                    let name = match self.to {
                        RosVersion::One => field.name.clone(),
                        RosVersion::Two => lower_name(&field.name),
                    };
                    if let Some(first) = names.insert(name.clone(), &field.name) {
                        return Err(NoTwinReason::SameName {
                            name: original.name().to_owned(),
                            first: first.clone(),
                            second: field.name.clone(),
                        });
                    }
                    let written = self.type_of(&Slot::from_field(field))?;
                    text.push_str(&format!("{written} {name}\n"));
                }
            }
            Some(rule) => {
                for (one, two) in &rule.fields {
                    let (from, name) = match self.to {
                        RosVersion::One => (two, one),
                        RosVersion::Two => (one, two),
                    };
                    let slot = self.ruled_slot(rule, original, twin, from, name)?;
                    let written = self.type_of(&slot)?;
                    text.push_str(&format!("{written} {name}\n"));
                }
            }
        }
        Ok(text)
    }

    /// Returns the field of `original` from which a rule makes field `name` of the twin.
    fn ruled_slot<'m>(
        &self,
        rule: &FieldRule,
        original: &'m MessageType,
        twin: &str,
        from: &str,
        name: &str,
    ) -> Result<Slot<'m>, NoTwinReason> {
        // A part of a field, or the message itself, does not tell what is around it.
        if name.contains('.') {
            return Err(NoTwinReason::NoDefinition {
                rule: rule.place.clone(),
                path: name.to_owned(),
                name: twin.to_owned(),
            });
        }
        let path = find_path(original, from);
        path.and_then(|path| Slot::at_path(original, &path)).ok_or_else(|| NoTwinReason::NoSuchField {
            rule: rule.place.clone(),
            path: from.to_owned(),
            name: original.name().to_owned(),
        })
    }

    /// Returns the type of a field as the twin's definition writes it.
    fn type_of(&mut self, slot: &Slot<'_>) -> Result<String, NoTwinReason> {
        let element = match (slot.base, self.to) {
            (SlotBase::Primitive(Primitive::Time), RosVersion::Two) => "builtin_interfaces/Time".to_owned(),
            (SlotBase::Primitive(Primitive::Duration), RosVersion::Two) => "builtin_interfaces/Duration".to_owned(),
            (SlotBase::Primitive(Primitive::Wstring), RosVersion::One) => "string".to_owned(),
            (SlotBase::Primitive(_), _) => slot.type_name.to_owned(),
            (SlotBase::Message(message), to) => match stamp_of_message(message).filter(|_| to == RosVersion::One) {
                Some(Stamp::Time) => "time".to_owned(),
                Some(Stamp::Duration) => "duration".to_owned(),
                None => {
                    let twin = (self.name_of)(message);
                    self.add_message(message, &twin)?;
                    let TypeName { package, short, .. } = TypeName::parse(&twin);
                    format!("{package}/{short}")
                }
            },
        };
        Ok(match slot.arity {
            Arity::One => element,
            Arity::Fixed(count) => format!("{element}[{count}]"),
            Arity::Variable => format!("{element}[]"),
        })
    }
}

/// Returns the line of a constant. `None` for one that the other ROS cannot express: constants are for people and
/// programs, and no message holds them.
fn constant_line(constant: &Constant, to: RosVersion) -> Option<String> {
    let Constant { name, type_name, value } = constant;
    let is_text = matches!(&**type_name, "string" | "wstring");
    let (type_name, value) = match (to, is_text) {
        (RosVersion::One, true) => {
            let is_one_line = value.trim() == value && !value.contains(['\n', '\r']);
            ("string", is_one_line.then(|| value.clone())?)
        }
        (RosVersion::Two, true) => {
            let quote = if value.contains('"') { '\'' } else { '"' };
            let is_quotable = !value.contains(quote) && !value.contains('\\');
            ("string", is_quotable.then(|| format!("{quote}{value}{quote}"))?)
        }
        (RosVersion::One, false) => (&**type_name, decimal(value)),
        // A bool of ROS 1 may be any number.
        (RosVersion::Two, false) if type_name == "bool" => match value.parse::<i64>() {
            Ok(number) => ("bool", (number != 0).to_string()),
            Err(_) => ("bool", value.clone()),
        },
        (RosVersion::Two, false) => (&**type_name, value.clone()),
    };
    let name = match to {
        RosVersion::One => name.clone(),
        RosVersion::Two => name.to_ascii_uppercase(),
    };
    Some(format!("{type_name} {name}={value}\n"))
}

/// Returns an integer in decimal notation, the only one of ROS 1; other values as they are.
fn decimal(value: &str) -> String {
    let (sign, digits) = match value.strip_prefix('-') {
        Some(digits) => ("-", digits),
        None => ("", value.strip_prefix('+').unwrap_or(value)),
    };
    let number = |prefixes: [&str; 2], radix: u32| {
        let digits = prefixes.iter().find_map(|prefix| digits.strip_prefix(prefix))?;
        u64::from_str_radix(digits, radix).ok()
    };
    let number = number(["0x", "0X"], 16).or_else(|| number(["0o", "0O"], 8)).or_else(|| number(["0b", "0B"], 2));
    match number {
        Some(number) => format!("{sign}{number}"),
        None => value.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn constants_are_written_for_the_other_ros() {
        let constant = |type_name: &str, name: &str, value: &str| Constant {
            name: name.to_owned(),
            type_name: type_name.to_owned(),
            value: value.to_owned(),
        };
        for (to, type_name, value, expected) in [
            (RosVersion::Two, "uint8", "7", Some("uint8 Aa=7\n")),
            (RosVersion::Two, "bool", "5", Some("bool Aa=true\n")),
            (RosVersion::Two, "string", "it's # a text", Some("string Aa=\"it's # a text\"\n")),
            (RosVersion::Two, "string", "say \"it's\"", None),
            (RosVersion::Two, "string", "back\\", None),
            (RosVersion::One, "uint8", "0xff", Some("uint8 Aa=255\n")),
            (RosVersion::One, "int8", "-0b11", Some("int8 Aa=-3\n")),
            (RosVersion::One, "float32", "1.5", Some("float32 Aa=1.5\n")),
            (RosVersion::One, "wstring", "ü", Some("string Aa=ü\n")),
            (RosVersion::One, "string", " a", None),
        ] {
            let found = constant_line(&constant(type_name, "Aa", value), to);
            let expected =
                expected.map(|line| if to == RosVersion::Two { line.replace("Aa", "AA") } else { line.to_owned() });
            assert_eq!(found, expected, "{type_name} {value}");
        }
    }
}
