//! Random types of either ROS, random messages of them, and random damage.

use proptest::prelude::*;
use ros_message::RosVersion::{One, Two};
use ros_message::schema::{Arity, Base, Primitive};

use super::*;

/// A source of choices that proptest can shrink: bytes, then zeros.
pub(super) struct Choices<'a>(std::slice::Iter<'a, u8>);

impl<'a> Choices<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Choices<'a> {
        Choices(bytes.iter())
    }

    fn byte(&mut self) -> u8 {
        self.0.next().copied().unwrap_or(0)
    }

    fn choose_below(&mut self, bound: usize) -> usize {
        usize::from(self.byte()) % bound
    }

    fn bytes<const N: usize>(&mut self) -> [u8; N] {
        std::array::from_fn(|_| self.byte())
    }
}

/// Generates a type `a/T0` with random fields, some of them of types `a/T1`, `a/T2`.
fn random_type(version: RosVersion, choices: &mut Choices<'_>) -> Arc<MessageType> {
    const TYPES: [&str; 17] = [
        "bool",
        "int8",
        "uint8",
        "byte",
        "char",
        "int16",
        "uint16",
        "int32",
        "uint32",
        "int64",
        "uint64",
        "float32",
        "float64",
        "string",
        "time",
        "duration",
        "std_msgs/Header",
    ];
    let two = version == Two;
    let registry = Registry::for_version(version);
    for level in (0..3).rev() {
        let mut text = String::new();
        for index in 0..choices.choose_below(7) {
            let pick = choices.choose_below(TYPES.len() + 2 * (2 - level));
            let nested = format!("T{}", if level == 1 { 2 } else { 1 + pick % 2 });
            let base = match TYPES.get(pick).copied().unwrap_or(&nested) {
                "time" if two => "builtin_interfaces/Time",
                "duration" if two => "builtin_interfaces/Duration",
                "string" if two => ["string", "wstring", "string<=40"][choices.choose_below(3)],
                other => other,
            };
            let brackets = if two { ["", "", "[]", "[3]", "[<=5]"] } else { ["", "", "[]", "[3]", "[1]"] };
            let brackets = brackets[choices.choose_below(5)];
            // Names that are the same in both, and some that are not.
            let name = if two || choices.choose_below(4) > 0 { format!("f{index}") } else { format!("fieldF{index}") };
            text.push_str(&format!("{base}{brackets} {name}\n"));
        }
        registry.insert(&format!("a/msg/T{level}"), &text).unwrap();
    }
    registry.message("a/T0").unwrap()
}

/// Writes messages that both ROSes can hold, without using any of the crate's code.
struct Writer {
    out: Vec<u8>,
    version: RosVersion,
    big_endian: bool,
}

impl Writer {
    /// Writes a number given as little-endian bytes.
    fn number(&mut self, bytes: &[u8]) {
        // The header has four bytes, so offsets count from four.
        while self.version == Two && (self.out.len() + 4) % bytes.len() != 0 {
            self.out.push(0);
        }
        let begin = self.out.len();
        self.out.extend_from_slice(bytes);
        if self.big_endian {
            self.out[begin..].reverse();
        }
    }

    fn length(&mut self, length: usize) {
        self.number(&(length as u32).to_le_bytes());
    }

    fn message(&mut self, message: &MessageType, choices: &mut Choices<'_>) {
        if matches!(message.name(), "builtin_interfaces/msg/Time" | "builtin_interfaces/msg/Duration") {
            return self.stamp(message.name().ends_with("Duration"), choices);
        }
        for field in message.fields() {
            let count = match field.arity {
                Arity::One => 1,
                Arity::Fixed(count) => count as usize,
                Arity::Variable => {
                    let most = field.bounds.elements.unwrap_or(3).min(3) as usize;
                    let count = choices.choose_below(most + 1);
                    self.length(count);
                    count
                }
            };
            for _ in 0..count {
                match &field.base {
                    // ROS 2 has no `seq`.
                    _ if message.name() == "std_msgs/Header" && field.name == "seq" => self.length(0),
                    Base::Message(inner) => self.message(inner, choices),
                    Base::Primitive(primitive) => self.value(*primitive, choices),
                }
            }
        }
        if self.version == Two && message.fields().is_empty() {
            self.out.push(0);
        }
    }

    fn value(&mut self, primitive: Primitive, choices: &mut Choices<'_>) {
        match primitive {
            Primitive::Bool => self.number(&[choices.byte() & 1]),
            Primitive::String | Primitive::Wstring => {
                let text: String = (0..choices.choose_below(5))
                    .map(|_| ['a', '"', 'ü', '机', '🤖', 'z'][choices.choose_below(6)])
                    .collect();
                self.text(&text, primitive == Primitive::Wstring);
            }
            Primitive::Time | Primitive::Duration => self.stamp(primitive == Primitive::Duration, choices),
            _ => self.number(&choices.bytes::<8>()[..primitive.size()]),
        }
    }

    fn stamp(&mut self, is_duration: bool, choices: &mut Choices<'_>) {
        let seconds = i32::from_le_bytes(choices.bytes());
        let seconds = if is_duration { seconds } else { seconds & i32::MAX };
        self.number(&seconds.to_le_bytes());
        self.number(&(u32::from_le_bytes(choices.bytes()) % 1_000_000_000).to_le_bytes());
    }

    fn text(&mut self, text: &str, wide: bool) {
        match (self.version, wide) {
            (One, _) => {
                self.length(text.len());
                self.out.extend_from_slice(text.as_bytes());
            }
            (Two, false) => {
                self.length(text.len() + 1);
                self.out.extend_from_slice(text.as_bytes());
                self.out.push(0);
            }
            (Two, true) => {
                let units: Vec<u16> = text.encode_utf16().collect();
                self.length(units.len());
                for unit in units {
                    self.number(&u32::from(unit).to_le_bytes());
                }
            }
        }
    }
}

/// Returns a random message that both ROSes can hold; in ROS 2 of either byte order.
pub(super) fn random_message(message: &MessageType, big_endian: bool, choices: &mut Choices<'_>) -> Vec<u8> {
    let out = match message.version() {
        One => Vec::new(),
        Two => vec![0, u8::from(!big_endian), 0, 0],
    };
    let big_endian = big_endian && message.version() == Two;
    let mut writer = Writer { out, version: message.version(), big_endian };
    writer.message(message, choices);
    writer.out
}

fn random(version: RosVersion, choices: &[u8], big_endian: bool) -> (Arc<MessageTwin>, Vec<u8>) {
    let mut choices = Choices::new(choices);
    let message = random_type(version, &mut choices);
    let bytes = random_message(&message, big_endian, &mut choices);
    (TypeTranslations::new(TranslationRules::default()).message(&message).unwrap(), bytes)
}

fn damage(bytes: &mut Vec<u8>, edits: &[(u16, u8, u8)]) {
    for (at, value, how) in edits {
        if bytes.is_empty() {
            return;
        }
        let at = usize::from(*at) % bytes.len();
        match how % 4 {
            0 => bytes[at] = *value,
            1 => bytes.insert(at, *value),
            2 => drop(bytes.remove(at)),
            _ => bytes.truncate(at),
        }
    }
}

/// Returns a definition with the same fields in another order, and one more.
fn shuffle_fields(message: &MessageType, choices: &mut Choices<'_>) -> String {
    let mut lines: Vec<&str> = message.text().lines().collect();
    lines.push("float64 extra");
    let mut text = String::new();
    while !lines.is_empty() {
        let at = choices.choose_below(lines.len());
        text.push_str(lines.remove(at));
        text.push('\n');
    }
    text
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn messages_come_back_as_they_were(choices in proptest::collection::vec(any::<u8>(), 0..400)) {
        for version in [One, Two] {
            let (pair, bytes) = random(version, &choices, false);
            let carried = pair.to_twin.translate(&bytes).unwrap();
            ros_message::codec::validate(&pair.twin, &carried).unwrap();
            prop_assert_eq!(&pair.from_twin.translate(&carried).unwrap()[..], &bytes[..]);
            prop_assert_eq!(pair.to_twin.saturated_count() + pair.from_twin.saturated_count(), 0);
            // In the other byte order they say the same.
            if version == Two {
                let (_, big) = random(version, &choices, true);
                prop_assert_eq!(pair.to_twin.translate(&big).unwrap(), carried);
            }
        }
    }

    #[test]
    fn fields_are_found_in_any_order(choices in proptest::collection::vec(any::<u8>(), 0..400)) {
        let (pair, bytes) = random(One, &choices, false);
        let registry = Registry::for_version(Two);
        registry.insert_full_text("a/T0", pair.twin.full_text()).unwrap();
        let mut order = Choices::new(&choices);
        for level in 0..3 {
            if let Ok(message) = registry.message(&format!("a/T{level}")) {
                registry.insert(&format!("a/T{level}"), &shuffle_fields(&message, &mut order)).unwrap();
            }
        }
        let translations = TypeTranslations::new(TranslationRules::default()).with_known(Arc::new(registry), Two);
        let other = translations.message(&pair.original).unwrap();
        let carried = other.to_twin.translate(&bytes).unwrap();
        ros_message::codec::validate(&other.twin, &carried).unwrap();
        prop_assert_eq!(&other.from_twin.translate(&carried).unwrap()[..], &bytes[..]);
    }

    #[test]
    fn damaged_messages_are_carried_or_refused(
        choices in proptest::collection::vec(any::<u8>(), 0..300),
        edits in proptest::collection::vec(any::<(u16, u8, u8)>(), 1..5),
        big_endian in any::<bool>(),
    ) {
        for version in [One, Two] {
            let (pair, mut bytes) = random(version, &choices, big_endian);
            damage(&mut bytes, &edits);
            let valid = ros_message::codec::validate(&pair.original, &bytes).is_ok();
            let carried = pair.to_twin.translate(&bytes);
            // Both readers agree on what a message is; some exceed a bound or the limit.
            prop_assert!(valid || carried.is_err());
            if let Ok(carried) = carried {
                ros_message::codec::validate(&pair.twin, &carried).unwrap();
                prop_assert!(carried.len() <= 16 * bytes.len() + 2 * pair.twin.min_size() + (66 << 10));
                prop_assert!(pair.from_twin.translate(&carried).is_ok() || version == Two);
            }
        }
    }

    #[test]
    fn any_bytes_are_borne(
        choices in proptest::collection::vec(any::<u8>(), 0..200),
        bytes in proptest::collection::vec(any::<u8>(), 0..100),
    ) {
        for version in [One, Two] {
            let (pair, _) = random(version, &choices, false);
            let _ = pair.to_twin.translate(&bytes);
            let _ = pair.to_twin.translate(&[&[0, 1, 0, 0], &bytes[..]].concat());
            let _ = pair.from_twin.translate(&[&[0, 0, 0, 0], &bytes[..]].concat());
        }
    }
}
