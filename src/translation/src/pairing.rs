//! Which field of one definition belongs to which field of the other.
//!
//! Without a rule, fields of one name belong together (capital letters and underscores aside, if that leaves no doubt).
//! A field on one side alone is left out there and has its default here; if both sides have such fields, they may be
//! the same thing under two names, and the messages are no pair. A rule lists all pairs, and what it does not list is
//! left out. This is how ros1_bridge decides too.

use std::collections::{HashMap, HashSet};

use ros_message::schema::{Arity, MessageType, Primitive};

use crate::error::{NoTwinReason, UnlikeFields};
use crate::number::Number;
use crate::rules::{FieldRule, TranslationRules};
use crate::shape::{Slot, SlotBase};
use crate::stamp::Stamp;

/// Indices of fields, from the top of a message; empty for the message itself.
pub(crate) type Path = Vec<usize>;

/// Two fields that belong together.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Pair {
    /// In ROS 1.
    pub(crate) one: Path,
    /// In ROS 2.
    pub(crate) two: Path,
}

/// The pairs of two messages and of all messages in them, by their names.
#[derive(Debug, Default)]
pub(crate) struct Pairings {
    messages: HashMap<(String, String), Vec<Pair>>,
}

impl Pairings {
    /// Adds two messages: `one` of ROS 1 and `two` of ROS 2.
    pub(crate) fn add(
        &mut self,
        rules: &TranslationRules,
        one: &MessageType,
        two: &MessageType,
    ) -> Result<(), NoTwinReason> {
        let key = (one.name().to_owned(), two.name().to_owned());
        if self.messages.contains_key(&key) {
            return Ok(());
        }
        let pairs = match rules.fields(one.name(), two.name()) {
            Some(rule) => pair_by_rule(rule, one, two)?,
            None => pair_by_name(one, two)?,
        };
        for pair in &pairs {
            let slots = (Slot::at_path(one, &pair.one), Slot::at_path(two, &pair.two));
            let (Some(one_slot), Some(two_slot)) = slots else {
                continue;
            };
            let unlike = || {
                NoTwinReason::FieldType(Box::new(UnlikeFields {
                    one: one.name().to_owned(),
                    one_field: write_path(one, &pair.one),
                    one_type: one_slot.definition_text(),
                    two: two.name().to_owned(),
                    two_field: write_path(two, &pair.two),
                    two_type: two_slot.definition_text(),
                }))
            };
            match relate(&one_slot, &two_slot).ok_or_else(unlike)? {
                Relation::Values => {}
                Relation::Messages(inner_one, inner_two) => self.add(rules, inner_one, inner_two)?,
            }
        }
        self.messages.insert(key, pairs);
        Ok(())
    }

    /// Returns the pairs of two messages that were added.
    pub(crate) fn get(&self, one: &str, two: &str) -> &[Pair] {
        self.messages.get(&(one.to_owned(), two.to_owned())).map_or(&[], Vec::as_slice)
    }
}

/// How the values of two fields are related.
enum Relation<'a> {
    /// They are converted into each other.
    Values,
    /// They are converted field by field.
    Messages(&'a MessageType, &'a MessageType),
}

/// Returns how a field of ROS 1 is related to one of ROS 2; `None` if they cannot be converted.
fn relate<'a>(one: &Slot<'a>, two: &Slot<'a>) -> Option<Relation<'a>> {
    let alike = match (one.arity, two.arity) {
        (Arity::One, other) | (other, Arity::One) => other == Arity::One,
        (Arity::Fixed(one), Arity::Fixed(two)) => one == two,
        (Arity::Variable, _) | (_, Arity::Variable) => true,
    };
    if !alike {
        return None;
    }
    match (one.base, two.base) {
        (SlotBase::Message(one), SlotBase::Message(two)) => Some(Relation::Messages(one, two)),
        (SlotBase::Primitive(one), SlotBase::Message(two)) => {
            (stamp_of_primitive(one)? == stamp_of_message(two)?).then_some(Relation::Values)
        }
        (SlotBase::Message(_), SlotBase::Primitive(_)) => None,
        (SlotBase::Primitive(one), SlotBase::Primitive(two)) => {
            let related = match (Number::from_primitive(one), Number::from_primitive(two)) {
                (Some(one), Some(two)) => one.is_convertible_to(two),
                (None, None) => is_text(one) && is_text(two),
                _ => false,
            };
            related.then_some(Relation::Values)
        }
    }
}

fn is_text(primitive: Primitive) -> bool {
    matches!(primitive, Primitive::String | Primitive::Wstring)
}

/// Returns the kind of a stamp of ROS 1.
pub(crate) fn stamp_of_primitive(primitive: Primitive) -> Option<Stamp> {
    match primitive {
        Primitive::Time => Some(Stamp::Time),
        Primitive::Duration => Some(Stamp::Duration),
        _ => None,
    }
}

/// Returns the kind of a stamp of ROS 2.
pub(crate) fn stamp_of_message(message: &MessageType) -> Option<Stamp> {
    let stamp = match message.name() {
        "builtin_interfaces/msg/Time" => Stamp::Time,
        "builtin_interfaces/msg/Duration" => Stamp::Duration,
        _ => return None,
    };
    let fields = message.fields().iter().map(|field| (&*field.name, &*field.type_name, field.arity));
    let expected = [("sec", "int32", Arity::One), ("nanosec", "uint32", Arity::One)];
    fields.eq(expected).then_some(stamp)
}

fn pair_by_name(one: &MessageType, two: &MessageType) -> Result<Vec<Pair>, NoTwinReason> {
    let mut by_name: HashMap<&str, usize> = two.fields().iter().map(|field| &*field.name).zip(0..).collect();
    let mut found: Vec<Option<usize>> = one.fields().iter().map(|field| by_name.remove(&*field.name)).collect();
    // What nobody claims, capital letters and underscores aside.
    let plain = |name: &str| name.replace('_', "").to_ascii_lowercase();
    let mut left: HashMap<String, Vec<usize>> = HashMap::new();
    for (name, index) in by_name {
        left.entry(plain(name)).or_default().push(index);
    }
    let mut waiting: HashMap<String, Vec<usize>> = HashMap::new();
    for (index, _) in found.iter().enumerate().filter(|(_, other)| other.is_none()) {
        waiting.entry(plain(&one.fields()[index].name)).or_default().push(index);
    }
    for (name, indices) in waiting {
        if let ([index], Some([other])) = (&indices[..], left.get(&name).map(Vec::as_slice)) {
            found[*index] = Some(*other);
        }
    }
    let taken: HashSet<usize> = found.iter().copied().flatten().collect();
    let names = |message: &MessageType, is_alone: &dyn Fn(usize) -> bool| -> Vec<String> {
        let fields = message.fields().iter().enumerate();
        fields.filter(|(index, _)| is_alone(*index)).map(|(_, field)| field.name.clone()).collect()
    };
    let only_in_one = names(one, &|index| found[index].is_none());
    let only_in_two = names(two, &|index| !taken.contains(&index));
    if !only_in_one.is_empty() && !only_in_two.is_empty() {
        let (one, two) = (one.name().to_owned(), two.name().to_owned());
        return Err(NoTwinReason::Fields { one, two, only_in_one, only_in_two });
    }
    let pairs = found.into_iter().enumerate();
    Ok(pairs.filter_map(|(one, two)| Some(Pair { one: vec![one], two: vec![two?] })).collect())
}

fn pair_by_rule(rule: &FieldRule, one: &MessageType, two: &MessageType) -> Result<Vec<Pair>, NoTwinReason> {
    let mut pairs: Vec<Pair> = Vec::with_capacity(rule.fields.len());
    for (written_one, written_two) in &rule.fields {
        let find = |message: &MessageType, written: &str| {
            find_path(message, written).ok_or_else(|| NoTwinReason::NoSuchField {
                rule: rule.place.clone(),
                path: written.to_owned(),
                name: message.name().to_owned(),
            })
        };
        let pair = Pair { one: find(one, written_one)?, two: find(two, written_two)? };
        let overlap = |message: &MessageType, written: &str| NoTwinReason::Overlap {
            rule: rule.place.clone(),
            path: written.to_owned(),
            name: message.name().to_owned(),
        };
        let touch = |a: &Path, b: &Path| a.starts_with(b) || b.starts_with(a);
        if pairs.iter().any(|other| touch(&other.one, &pair.one)) {
            return Err(overlap(one, written_one));
        }
        if pairs.iter().any(|other| touch(&other.two, &pair.two)) {
            return Err(overlap(two, written_two));
        }
        pairs.push(pair);
    }
    Ok(pairs)
}

/// Returns the field that a rule names: `a.b.c`, or `.` for the message itself.
pub(crate) fn find_path(message: &MessageType, written: &str) -> Option<Path> {
    let mut path = Path::new();
    if written == "." {
        return Some(path);
    }
    for name in written.split('.') {
        let slot = Slot::at_path(message, &path)?;
        let SlotBase::Message(inner) = slot.base else {
            return None;
        };
        if slot.arity != Arity::One {
            return None;
        }
        path.push(inner.fields().iter().position(|field| field.name == name)?);
    }
    Some(path)
}

/// Returns a path as a rule writes it.
pub(crate) fn write_path(message: &MessageType, path: &[usize]) -> String {
    let mut names = Vec::new();
    for end in 0..path.len() {
        if let Some(Slot { base: SlotBase::Message(inner), .. }) = Slot::at_path(message, &path[..end]) {
            names.extend(inner.fields().get(path[end]).map(|field| &*field.name));
        }
    }
    names.join(".")
}
