//! Random types of either ROS version, random messages of them, and random damage.

use proptest::prelude::*;

use super::*;
use crate::RosVersion;
use crate::schema::{Arity, Base, Primitive};

const VERSIONS: [RosVersion; 2] = [RosVersion::One, RosVersion::Two];

/// A source of choices that proptest can shrink: bytes, then zeros.
struct Choices<'a>(std::slice::Iter<'a, u8>);

impl Choices<'_> {
    fn byte(&mut self) -> u8 {
        self.0.next().copied().unwrap_or(0)
    }

    fn choose_below(&mut self, bound: usize) -> usize {
        usize::from(self.byte()) % bound
    }

    fn word(&mut self) -> u64 {
        u64::from_le_bytes(std::array::from_fn(|_| self.byte()))
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
    let two = version == RosVersion::Two;
    let registry = Registry::for_version(version);
    for level in (0..3).rev() {
        let mut text = String::new();
        for index in 0..choices.choose_below(7) {
            let pick = choices.choose_below(TYPES.len() + 2 * (2 - level));
            let nested = format!("T{}", level + 1 + (pick % 2) % (3 - level).max(1));
            let nested = if level == 1 { "T2".to_owned() } else { nested };
            let base = match TYPES.get(pick).copied().unwrap_or(&nested) {
                "time" if two => "builtin_interfaces/Time",
                "duration" if two => "builtin_interfaces/Duration",
                "string" if two => ["string", "wstring", "string<=40"][choices.choose_below(3)],
                other => other,
            };
            let brackets = if two {
                ["", "", "[]", "[3]", "[<=5]"][choices.choose_below(5)]
            } else {
                ["", "", "[]", "[3]", "[0]"][choices.choose_below(5)]
            };
            // A definition may have defaults for missing fields.
            let value = match (two && choices.choose_below(4) == 0, base, brackets) {
                (true, "uint16" | "float64" | "string" | "wstring", "") => " 7",
                (true, "int64" | "string<=40", "[]" | "[<=5]") => " [1, 2]",
                _ => "",
            };
            // Names out of alphabetical order, so that sorted keys are out of order.
            let letter = char::from(b'z' - (index as u8 * 7 + level as u8) % 26);
            text.push_str(&format!("{base}{brackets} {letter}{index}{value}\n"));
        }
        registry.insert(&format!("a/msg/T{level}"), &text).unwrap();
    }
    registry.message("a/T0").unwrap()
}

/// Writes messages without using any of the codec's code.
struct Writer {
    out: Vec<u8>,
    version: RosVersion,
    big_endian: bool,
    /// Value of padding bytes; any value is valid.
    padding: u8,
    /// Offsets of the times written.
    times: Vec<usize>,
}

impl Writer {
    fn new(version: RosVersion, big_endian: bool, padding: u8) -> Writer {
        let out = match version {
            RosVersion::One => Vec::new(),
            RosVersion::Two => vec![0, u8::from(!big_endian), 0, 0],
        };
        Writer { out, version, big_endian, padding, times: Vec::new() }
    }

    /// Writes a number given as little-endian bytes.
    fn number(&mut self, bytes: &[u8]) {
        // The header has four bytes, so offsets count from four.
        while self.version == RosVersion::Two && (self.out.len() + 4) % bytes.len() != 0 {
            self.out.push(self.padding);
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
        if message.name() == "builtin_interfaces/msg/Time" {
            self.times.push(self.out.len().next_multiple_of(4));
        }
        for field in message.fields() {
            let count = match field.arity {
                Arity::One => 1,
                Arity::Fixed(count) => count as usize,
                Arity::Variable => {
                    let count = choices.choose_below(5);
                    self.length(count);
                    count
                }
            };
            for _ in 0..count {
                match &field.base {
                    Base::Message(inner) => self.message(inner, choices),
                    Base::Primitive(primitive) => self.value(*primitive, choices),
                }
            }
        }
        if self.version == RosVersion::Two && message.fields().is_empty() {
            self.out.push(self.padding);
        }
    }

    fn value(&mut self, primitive: Primitive, choices: &mut Choices<'_>) {
        match primitive {
            Primitive::Bool => self.number(&[choices.byte() & 1]),
            // Finite, or a single NaN: which NaN it was is not preserved. With few digits, because serde_json rounds
            // long numbers in its own way.
            Primitive::Float32 => {
                let value = match choices.choose_below(8) {
                    0 => f32::NAN,
                    1 => f32::INFINITY,
                    _ => (choices.word() as i16) as f32 / 64.0,
                };
                self.number(&value.to_le_bytes());
            }
            Primitive::Float64 => {
                let value = match choices.choose_below(8) {
                    0 => f64::NAN,
                    1 => f64::NEG_INFINITY,
                    _ => (choices.word() as i16) as f64 / 1024.0,
                };
                self.number(&value.to_le_bytes());
            }
            Primitive::String | Primitive::Wstring => {
                let text: String = (0..choices.choose_below(12))
                    .map(|_| ['a', '"', '\\', '\n', 'ü', '机', '🤖', '\0', 'z'][choices.choose_below(9)])
                    .collect();
                self.text(&text, primitive == Primitive::Wstring);
            }
            Primitive::Time | Primitive::Duration => {
                if primitive == Primitive::Time {
                    self.times.push(self.out.len());
                }
                self.number(&(choices.word() as u32).to_le_bytes());
                self.number(&(choices.word() as u32).to_le_bytes());
            }
            _ => self.number(&choices.word().to_le_bytes()[..primitive.size()]),
        }
    }

    fn text(&mut self, text: &str, wide: bool) {
        match (self.version, wide) {
            (RosVersion::One, _) => {
                self.length(text.len());
                self.out.extend_from_slice(text.as_bytes());
            }
            (RosVersion::Two, false) => {
                self.length(text.len() + 1);
                self.out.extend_from_slice(text.as_bytes());
                self.out.push(0);
            }
            (RosVersion::Two, true) => {
                let units: Vec<u16> = text.encode_utf16().collect();
                self.length(units.len());
                for unit in units {
                    self.number(&u32::from(unit).to_le_bytes());
                }
            }
        }
    }
}

fn random(version: RosVersion, choices: &[u8]) -> (Arc<MessageType>, Vec<u8>) {
    let (message, writer) = random_of(version, choices, false, 0);
    (message, writer.out)
}

fn random_of(version: RosVersion, choices: &[u8], big_endian: bool, padding: u8) -> (Arc<MessageType>, Writer) {
    let mut choices = Choices(choices.iter());
    let message = random_type(version, &mut choices);
    let mut writer = Writer::new(version, big_endian, padding);
    writer.message(&message, &mut choices);
    (message, writer)
}

/// Compares values, except bytes given as text.
fn is_same(value: &Value<'_>, json: &serde_json::Value) -> bool {
    use serde_json::Value as Json;
    match (value, json) {
        (Value::Number(number), Json::Bool(json)) => *number == f64::from(u8::from(*json)),
        // Integers are rounded, singles are written in short form.
        (Value::Number(number), Json::Number(json)) => {
            json.as_f64().is_some_and(|json| json == *number || json as f32 == *number as f32)
        }
        (Value::Number(number), Json::String(_)) => !number.is_finite(),
        (Value::Text(_), Json::String(json)) => value.text().as_ref() == Some(json),
        (Value::Time(time), Json::Object(json)) => {
            let part = |names: [&str; 2]| {
                let part = names.into_iter().find_map(|name| json.get(name))?;
                part.as_i64().map(|part| part as u32)
            };
            let parts = (part(["secs", "sec"]), part(["nsecs", "nanosec"]));
            parts == (Some(time.secs), Some(time.nsecs))
        }
        (Value::List(_), Json::String(_)) => true,
        (Value::List(list), Json::Array(json)) => {
            list.len() == json.len() && list.iter().zip(json).all(|(a, b)| is_same(a, b))
        }
        (Value::Message(fields), Json::Object(json)) => {
            let same = |(name, value): &(&str, Value<'_>)| json.get(*name).is_some_and(|json| is_same(value, json));
            fields.len() == json.len() && fields.iter().all(same)
        }
        _ => false,
    }
}

fn json_options() -> JsonOptions {
    JsonOptions { non_finite: NonFinite::String, max_bytes: 1 << 20, ..JsonOptions::default() }
}

fn fill_options() -> FillOptions {
    FillOptions { now: Some(Time { secs: 1, nsecs: 2 }), max_bytes: 1 << 20 }
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

/// Checks that valid messages are written and invalid ones refused. A valid message is refused only if it would exceed
/// the limit: a few damaged bytes can ask for tens of thousands of elements of a type without fields, which take no ROS
/// bytes but much JSON.
fn agrees(valid: &Result<(), CodecError>, written: &Result<(), CodecError>) -> bool {
    match written {
        Err(error) if matches!(error.kind, CodecErrorKind::TooLarge(_)) => true,
        _ => valid.is_ok() == written.is_ok(),
    }
}

#[test]
fn many_elements_of_a_type_without_fields_are_written_up_to_the_limit() {
    let registry = Registry::new();
    registry.insert("a/msg/Nothing", "").unwrap();
    registry.insert("a/msg/Many", "Nothing[] all").unwrap();
    let message = registry.message("a/Many").unwrap();
    let bytes = 58_368_u32.to_le_bytes();
    validate(&message, &bytes).unwrap();
    for limit in [0, 1, 1 << 10, 1 << 15] {
        let (mut json, mut cbor) = (Vec::new(), Vec::new());
        let options = JsonOptions { max_bytes: limit, ..json_options() };
        let refused = to_json(&message, &bytes, &mut json, &options).unwrap_err();
        assert_eq!(refused.kind, CodecErrorKind::TooLarge(limit), "{refused}");
        assert!(json.len() <= limit + 16, "{} bytes were written with a limit of {limit}", json.len());
        let options = CborOptions { max_bytes: limit, ..CborOptions::default() };
        let refused = to_cbor(&message, &bytes, &mut cbor, &options).unwrap_err();
        assert_eq!(refused.kind, CodecErrorKind::TooLarge(limit), "{refused}");
        assert!(cbor.len() <= limit + 16, "{} bytes were written with a limit of {limit}", cbor.len());
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn json_and_cbor_give_back_what_they_were_made_of(choices in proptest::collection::vec(any::<u8>(), 0..400)) {
        for version in VERSIONS {
        let (message, bytes) = random(version, &choices);
        validate(&message, &bytes).unwrap();

        let mut json = Vec::new();
        to_json(&message, &bytes, &mut json, &json_options()).unwrap();
        let mut back = Vec::new();
        from_json(&message, &json, &mut back, &fill_options()).unwrap();
        prop_assert_eq!(&back, &bytes);
        prop_assert_eq!(json_value_len(&json).unwrap(), json.len());

        // Through another library's tree, in which keys are sorted by name.
        let tree: serde_json::Value = serde_json::from_slice(&json).unwrap();
        back.clear();
        from_json(&message, tree.to_string().as_bytes(), &mut back, &fill_options()).unwrap();
        prop_assert_eq!(&back, &bytes);

        for typed_arrays in [true, false] {
            let mut cbor = Vec::new();
            to_cbor(&message, &bytes, &mut cbor, &CborOptions { typed_arrays, ..CborOptions::default() }).unwrap();
            back.clear();
            from_cbor(&message, &cbor, &mut back, &fill_options()).unwrap();
            prop_assert_eq!(&back, &bytes);
            prop_assert_eq!(cbor_item_len(&cbor).unwrap(), cbor.len());
        }
        }
    }

    #[test]
    fn both_orders_of_bytes_and_any_padding_say_the_same(
        choices in proptest::collection::vec(any::<u8>(), 0..400),
        padding in any::<u8>(),
    ) {
        let (message, bytes) = random(RosVersion::Two, &choices);
        let (mut json, mut cbor) = (Vec::new(), Vec::new());
        to_json(&message, &bytes, &mut json, &json_options()).unwrap();
        to_cbor(&message, &bytes, &mut cbor, &CborOptions::default()).unwrap();
        for big_endian in [false, true] {
            let (message, writer) = random_of(RosVersion::Two, &choices, big_endian, padding);
            let mut other = writer.out;
            other.extend([padding; 3]);
            let (mut again, mut cbor_again) = (Vec::new(), Vec::new());
            to_json(&message, &other, &mut again, &json_options()).unwrap();
            to_cbor(&message, &other, &mut cbor_again, &CborOptions::default()).unwrap();
            prop_assert_eq!(&again, &json);
            prop_assert_eq!(&cbor_again, &cbor);
        }
    }

    #[test]
    fn values_and_stamps_are_where_the_writer_put_them(
        choices in proptest::collection::vec(any::<u8>(), 0..400),
        padding in any::<u8>(),
    ) {
        for (version, big_endian) in [(RosVersion::One, false), (RosVersion::Two, false), (RosVersion::Two, true)] {
            let (message, writer) = random_of(version, &choices, big_endian, padding);
            let bytes = writer.out;
            let mut json = Vec::new();
            to_json(&message, &bytes, &mut json, &json_options()).unwrap();
            let json = serde_json::from_slice(&json).unwrap();
            let value = Value::read(&message, &bytes);
            // More elements without bytes than there are bytes left are not read; only those of ROS 1 have no bytes.
            let same = value.as_ref().map_or(version == RosVersion::One, |value| is_same(value, &json));
            prop_assert!(same, "{:?} is not {}", value, json);
            let stamps = Stamps::for_type(&message);
            prop_assert_eq!(stamps.find(&bytes), Some(writer.times.clone()));
            // Whatever is written there is read back, and nothing else is changed.
            let mut again = bytes.clone();
            for at in writer.times {
                let stamp = stamps.read(&bytes, at).unwrap();
                let other = Time { secs: !stamp.secs, nsecs: !stamp.nsecs };
                stamps.write(&mut again, at, other);
                prop_assert_eq!(stamps.read(&again, at), Some(other));
                stamps.write(&mut again, at, stamp);
            }
            prop_assert_eq!(again, bytes);
        }
    }

    #[test]
    fn the_default_message_is_what_an_empty_object_makes(choices in proptest::collection::vec(any::<u8>(), 0..100)) {
        for version in VERSIONS {
            let message = random_type(version, &mut Choices(choices.iter()));
            let bytes = default_message(&message);
            validate(&message, &bytes).unwrap();
            let mut again = Vec::new();
            let options = FillOptions { now: None, ..fill_options() };
            from_json(&message, default_json(&message).as_bytes(), &mut again, &options).unwrap();
            prop_assert_eq!(&again, &bytes);
            if version == RosVersion::One {
                prop_assert_eq!(bytes, vec![0; message.min_size()]);
            } else {
                prop_assert!(bytes.len() >= 4 + message.min_size());
            }
        }
    }

    #[test]
    fn a_message_is_put_behind_others_and_taken_out_again(
        choices in proptest::collection::vec(any::<u8>(), 0..400),
        before in proptest::collection::vec(any::<u8>(), 0..20),
        big_endian in any::<bool>(),
        padding in any::<u8>(),
    ) {
        let write = |before: &[u8], padding| {
            let mut choices = Choices(choices.iter());
            let message = random_type(RosVersion::Two, &mut choices);
            let mut writer = Writer::new(RosVersion::Two, big_endian, padding);
            writer.out.extend_from_slice(before);
            writer.message(&message, &mut choices);
            (message, writer.out)
        };
        let (message, alone) = write(&[], 0);
        let (_, behind) = write(&before, 0);
        prop_assert_eq!(&embedded::extract_embedded(&message, &alone, 0, &before).unwrap(), &behind);
        prop_assert_eq!(&embedded::extract_embedded(&message, &behind, before.len(), &[]).unwrap(), &alone);
        // With any padding before it and any bytes after it.
        let (_, mut padded) = write(&before, padding);
        padded.extend([padding; 3]);
        let taken = embedded::extract_embedded(&message, &padded, before.len(), &[]).unwrap();
        let (mut json, mut expected) = (Vec::new(), Vec::new());
        to_json(&message, &taken, &mut json, &json_options()).unwrap();
        to_json(&message, &alone, &mut expected, &json_options()).unwrap();
        prop_assert_eq!(json, expected);
    }

    #[test]
    fn what_is_damaged_is_not_taken_out_or_is_no_longer_than_it_was(
        choices in proptest::collection::vec(any::<u8>(), 0..300),
        before in 0..20usize,
        edits in proptest::collection::vec(any::<(u16, u8, u8)>(), 1..6),
    ) {
        let (message, mut bytes) = random(RosVersion::Two, &choices);
        damage(&mut bytes, &edits);
        if let Some(taken) = embedded::extract_embedded(&message, &bytes, before, &[]) {
            // Each value may need different padding.
            prop_assert!(taken.len() <= 8 * bytes.len());
        }
    }

    #[test]
    fn damaged_input_is_refused_or_makes_a_message(
        choices in proptest::collection::vec(any::<u8>(), 0..300),
        edits in proptest::collection::vec(any::<(u16, u8, u8)>(), 1..6),
    ) {
        for version in VERSIONS {
        let (message, mut bytes) = random(version, &choices);
        let (mut json, mut cbor, mut back) = (Vec::new(), Vec::new(), Vec::new());
        to_json(&message, &bytes, &mut json, &json_options()).unwrap();
        to_cbor(&message, &bytes, &mut cbor, &CborOptions::default()).unwrap();
        damage(&mut json, &edits);
        damage(&mut cbor, &edits);
        damage(&mut bytes, &edits);

        if from_json(&message, &json, &mut back, &fill_options()).is_ok() {
            validate(&message, &back).unwrap();
        }
        prop_assert!(json_value_len(&json).is_err() || json_value_len(&json).unwrap() <= json.len());
        back.clear();
        if from_cbor(&message, &cbor, &mut back, &fill_options()).is_ok() {
            validate(&message, &back).unwrap();
            prop_assert_eq!(cbor_item_len(&cbor).unwrap(), cbor.len());
        }
        let valid = validate(&message, &bytes);
        let (mut json, mut cbor) = (Vec::new(), Vec::new());
        let written = to_json(&message, &bytes, &mut json, &json_options());
        if written.is_ok() {
            serde_json::from_slice::<serde_json::Value>(&json).unwrap();
        }
        prop_assert!(agrees(&valid, &written), "{valid:?}, yet JSON {written:?}");
        let written = to_cbor(&message, &bytes, &mut cbor, &CborOptions::default());
        prop_assert!(agrees(&valid, &written), "{valid:?}, yet CBOR {written:?}");
        prop_assert!(Stamps::for_type(&message).find(&bytes).is_none_or(|found| found.iter().all(
            |at| at + 8 <= bytes.len())));
        }
    }

    #[test]
    fn garbage_never_panics(
        choices in proptest::collection::vec(any::<u8>(), 0..60),
        garbage in proptest::collection::vec(any::<u8>(), 0..200),
    ) {
        for version in VERSIONS {
        let message = random_type(version, &mut Choices(choices.iter()));
        let mut out = Vec::new();
        let _ = from_json(&message, &garbage, &mut out, &fill_options());
        let _ = from_cbor(&message, &garbage, &mut out, &fill_options());
        let _ = to_json(&message, &garbage, &mut out, &json_options());
        let _ = Value::read(&message, &garbage);
        let _ = cbor_item_len(&garbage);
        let _ = json_value_len(&garbage);
        prop_assert!(out.len() <= 4 << 20);
        }
    }

    #[test]
    fn decimals_are_rounded_as_the_standard_library_does(
        digits in "-?(0|[1-9][0-9]{0,24})(\\.[0-9]{1,25})?(e[+-]?[0-9]{1,2})?",
        single in any::<u32>(),
        double in any::<u64>(),
    ) {
        let (message32, message64) = (message("std_msgs/Float32"), message("std_msgs/Float64"));
        let (single, double) = (f32::from_bits(single), f64::from_bits(double));
        // Decimals of singles, and of points half-way between them, are the hard cases.
        let half_way = f64::from_bits((f64::from(single).to_bits() & !0x1fff_ffff) | 0x1000_0000);
        for text in [digits, single.to_string(), double.to_string(), format!("{half_way}"), format!("{half_way}1")] {
            if text.contains(['n', 'N']) {
                continue; // neither inf nor NaN is a decimal
            }
            let (value32, value64): (f32, f64) = (text.parse().unwrap(), text.parse().unwrap());
            let json = format!("{{\"data\":{text}}}");
            if value32.is_finite() {
                prop_assert_eq!(ros_of(&message32, &json).unwrap(), value32.to_le_bytes());
            }
            if value64.is_finite() {
                prop_assert_eq!(ros_of(&message64, &json).unwrap(), value64.to_le_bytes());
            }
        }
    }
}
