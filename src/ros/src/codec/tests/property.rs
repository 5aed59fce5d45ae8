//! Random types, random messages of them, and random damage.

use proptest::prelude::*;

use super::*;
use crate::schema::{Arity, Base, Field, Primitive};

/// A source of choices that proptest can shrink: bytes, then zeros.
struct Choices<'a>(std::slice::Iter<'a, u8>);

impl Choices<'_> {
    fn byte(&mut self) -> u8 {
        self.0.next().copied().unwrap_or(0)
    }

    fn below(&mut self, bound: usize) -> usize {
        usize::from(self.byte()) % bound
    }

    fn word(&mut self) -> u64 {
        u64::from_le_bytes(std::array::from_fn(|_| self.byte()))
    }
}

/// A type `a/T0` made of random fields, some of them of types `a/T1`, `a/T2`.
fn random_type(choices: &mut Choices<'_>) -> Arc<MessageType> {
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
    let registry = Registry::new();
    for level in (0..3).rev() {
        let mut text = String::new();
        for index in 0..choices.below(7) {
            let pick = choices.below(TYPES.len() + 2 * (2 - level));
            let nested = format!("T{}", level + 1 + (pick % 2) % (3 - level).max(1));
            let nested = if level == 1 { "T2".to_owned() } else { nested };
            let base = TYPES.get(pick).copied().unwrap_or(&nested);
            let brackets = ["", "", "[]", "[3]", "[0]"][choices.below(5)];
            // Names out of alphabetical order: sorted keys are then out of order.
            let letter = char::from(b'z' - (index as u8 * 7 + level as u8) % 26);
            text.push_str(&format!("{base}{brackets} {letter}{index}\n"));
        }
        registry.insert(&format!("a/msg/T{level}"), &text).unwrap();
    }
    registry.message("a/T0").unwrap()
}

fn random_message(fields: &[Field], choices: &mut Choices<'_>, out: &mut Vec<u8>) {
    for field in fields {
        let count = match field.arity {
            Arity::One => 1,
            Arity::Fixed(count) => count as usize,
            Arity::Variable => {
                let count = choices.below(5);
                out.extend_from_slice(&(count as u32).to_le_bytes());
                count
            }
        };
        for _ in 0..count {
            match &field.base {
                Base::Message(inner) => random_message(inner.fields(), choices, out),
                Base::Primitive(primitive) => random_value(*primitive, choices, out),
            }
        }
    }
}

fn random_value(primitive: Primitive, choices: &mut Choices<'_>, out: &mut Vec<u8>) {
    match primitive {
        Primitive::Bool => out.push(choices.byte() & 1),
        // Finite or one NaN: which NaN it was is not kept. Of few digits, for serde_json rounds long ones its own way.
        Primitive::Float32 => {
            let value = match choices.below(8) {
                0 => f32::NAN,
                1 => f32::INFINITY,
                _ => (choices.word() as i16) as f32 / 64.0,
            };
            out.extend_from_slice(&value.to_le_bytes());
        }
        Primitive::Float64 => {
            let value = match choices.below(8) {
                0 => f64::NAN,
                1 => f64::NEG_INFINITY,
                _ => (choices.word() as i16) as f64 / 1024.0,
            };
            out.extend_from_slice(&value.to_le_bytes());
        }
        Primitive::String => {
            let text: String = (0..choices.below(12))
                .map(|_| ['a', '"', '\\', '\n', 'ü', '机', '🤖', '\0', 'z'][choices.below(9)])
                .collect();
            out.extend_from_slice(&(text.len() as u32).to_le_bytes());
            out.extend_from_slice(text.as_bytes());
        }
        _ => out.extend_from_slice(&choices.word().to_le_bytes()[..primitive.size()]),
    }
}

fn random(choices: &[u8]) -> (Arc<MessageType>, Vec<u8>) {
    let mut choices = Choices(choices.iter());
    let message = random_type(&mut choices);
    let mut bytes = Vec::new();
    random_message(message.fields(), &mut choices, &mut bytes);
    (message, bytes)
}

fn json_options() -> JsonOptions {
    JsonOptions {
        non_finite: NonFinite::String,
        max_bytes: 1 << 20,
        ..JsonOptions::default()
    }
}

fn fill_options() -> FillOptions {
    FillOptions {
        now: Some(Time { secs: 1, nsecs: 2 }),
        max_bytes: 1 << 20,
    }
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

/// What is valid is written and what is not is refused; only what would grow beyond the limit is refused though valid: a
/// few damaged bytes can ask for tens of thousands of elements of a type without fields, which hold nothing in ROS bytes and much in JSON.
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
        let options = JsonOptions {
            max_bytes: limit,
            ..json_options()
        };
        let refused = to_json(&message, &bytes, &mut json, &options).unwrap_err();
        assert_eq!(refused.kind, CodecErrorKind::TooLarge(limit), "{refused}");
        assert!(
            json.len() <= limit + 16,
            "{} bytes were written with a limit of {limit}",
            json.len()
        );
        let options = CborOptions {
            max_bytes: limit,
            ..CborOptions::default()
        };
        let refused = to_cbor(&message, &bytes, &mut cbor, &options).unwrap_err();
        assert_eq!(refused.kind, CodecErrorKind::TooLarge(limit), "{refused}");
        assert!(
            cbor.len() <= limit + 16,
            "{} bytes were written with a limit of {limit}",
            cbor.len()
        );
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn json_and_cbor_give_back_what_they_were_made_of(choices in proptest::collection::vec(any::<u8>(), 0..400)) {
        let (message, bytes) = random(&choices);
        validate(&message, &bytes).unwrap();

        let mut json = Vec::new();
        to_json(&message, &bytes, &mut json, &json_options()).unwrap();
        let mut back = Vec::new();
        from_json(&message, &json, &mut back, &fill_options()).unwrap();
        prop_assert_eq!(&back, &bytes);
        prop_assert_eq!(json_value_len(&json).unwrap(), json.len());

        // Through another's tree, where keys are sorted by name.
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

    #[test]
    fn damaged_input_is_refused_or_makes_a_message(
        choices in proptest::collection::vec(any::<u8>(), 0..300),
        edits in proptest::collection::vec(any::<(u16, u8, u8)>(), 1..6),
    ) {
        let (message, mut bytes) = random(&choices);
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
    }

    #[test]
    fn garbage_never_panics(
        choices in proptest::collection::vec(any::<u8>(), 0..60),
        garbage in proptest::collection::vec(any::<u8>(), 0..200),
    ) {
        let message = random_type(&mut Choices(choices.iter()));
        let mut out = Vec::new();
        let _ = from_json(&message, &garbage, &mut out, &fill_options());
        let _ = from_cbor(&message, &garbage, &mut out, &fill_options());
        let _ = to_json(&message, &garbage, &mut out, &json_options());
        let _ = cbor_item_len(&garbage);
        let _ = json_value_len(&garbage);
        prop_assert!(out.len() <= 4 << 20);
    }

    #[test]
    fn decimals_are_rounded_as_the_standard_library_does(
        digits in "-?(0|[1-9][0-9]{0,24})(\\.[0-9]{1,25})?(e[+-]?[0-9]{1,2})?",
        single in any::<u32>(),
        double in any::<u64>(),
    ) {
        let (message32, message64) = (message("std_msgs/Float32"), message("std_msgs/Float64"));
        let (single, double) = (f32::from_bits(single), f64::from_bits(double));
        // Decimals of singles and of points half-way between them are the hard ones.
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
