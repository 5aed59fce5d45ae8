//! Serialized parameter values (`rcl_interfaces/msg/ParameterValue`): a number that selects one of nine fields, and all
//! nine fields.

use base64_simd::STANDARD as BASE64;
use ros_bus::{ParamValue, ParameterKind};
use ros_message::codec::put::CdrWriter;

use super::reading::ParameterReader;

/// Largest magnitude up to which doubles represent all integers.
const EXACT: u64 = 1 << 53;

/// A value of a type defined by ROS 2.
#[derive(Debug, Clone, PartialEq)]
pub enum TypedValue {
    /// No value.
    NotSet,
    /// A bool.
    Bool(bool),
    /// An `int64`.
    Integer(i64),
    /// A `float64`.
    Double(f64),
    /// A text.
    String(String),
    /// An array of bytes.
    Bytes(Vec<u8>),
    /// An array of bools.
    Bools(Vec<bool>),
    /// An array of `int64`.
    Integers(Vec<i64>),
    /// An array of `float64`.
    Doubles(Vec<f64>),
    /// An array of texts.
    Strings(Vec<String>),
}

impl TypedValue {
    /// Returns the type.
    pub fn kind(&self) -> ParameterKind {
        match self {
            Self::NotSet => ParameterKind::NotSet,
            Self::Bool(_) => ParameterKind::Bool,
            Self::Integer(_) => ParameterKind::Integer,
            Self::Double(_) => ParameterKind::Double,
            Self::String(_) => ParameterKind::String,
            Self::Bytes(_) => ParameterKind::Bytes,
            Self::Bools(_) => ParameterKind::Bools,
            Self::Integers(_) => ParameterKind::Integers,
            Self::Doubles(_) => ParameterKind::Doubles,
            Self::Strings(_) => ParameterKind::Strings,
        }
    }
}

/// The types in the order of their numbers in `rcl_interfaces/msg/ParameterType`.
const KINDS: [ParameterKind; 10] = [
    ParameterKind::NotSet,
    ParameterKind::Bool,
    ParameterKind::Integer,
    ParameterKind::Double,
    ParameterKind::String,
    ParameterKind::Bytes,
    ParameterKind::Bools,
    ParameterKind::Integers,
    ParameterKind::Doubles,
    ParameterKind::Strings,
];

/// Returns the number of a type in `rcl_interfaces/msg/ParameterType`.
pub fn number_from_kind(kind: ParameterKind) -> u8 {
    KINDS.iter().zip(0..).find_map(|(known, number)| (*known == kind).then_some(number)).unwrap_or(0)
}

/// Returns the type of this number in `rcl_interfaces/msg/ParameterType`; an unknown number counts as not set.
pub fn kind_from_number(number: u8) -> ParameterKind {
    KINDS.get(usize::from(number)).copied().unwrap_or_default()
}

/// Returns true if the value's type may have to be adapted to the parameter's, or is not determined by the value.
pub fn depends_on_kind(value: &ParamValue) -> bool {
    !matches!(value, ParamValue::Bool(_) | ParamValue::Binary(_) | ParamValue::Nil)
}

/// The reason why no ROS 2 parameter can have a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum CoerceError {
    /// Only values have parameters.
    #[error("a ROS 2 parameter cannot be a dictionary: set each of its values")]
    Dictionary,
    /// A list needs a type.
    #[error("an empty list does not say what it is a list of")]
    EmptyList,
    /// A list has one type.
    #[error("a list holds values of one type: all booleans, numbers or strings")]
    MixedList,
}

/// Converts the value to the parameter's type where that is lossless; otherwise leaves it for the node to judge.
pub fn coerce(value: ParamValue, kind: ParameterKind) -> Result<TypedValue, CoerceError> {
    let natural = match (value, kind) {
        (ParamValue::Int(value), ParameterKind::Double) if is_exact(value) => TypedValue::Double(value as f64),
        (ParamValue::Double(value), ParameterKind::Integer) if is_integer(value) => TypedValue::Integer(value as i64),
        // JSON has no bytes: they are given as base64, or as numbers.
        (ParamValue::String(text), ParameterKind::Bytes) => match BASE64.decode_to_vec(text.as_bytes()) {
            Ok(bytes) => TypedValue::Bytes(bytes),
            Err(_) => TypedValue::String(text),
        },
        (ParamValue::List(items), kind) => coerce_list(items, kind)?,
        (ParamValue::Nil, _) => TypedValue::NotSet,
        (ParamValue::Bool(value), _) => TypedValue::Bool(value),
        (ParamValue::Int(value), _) => TypedValue::Integer(value),
        (ParamValue::Double(value), _) => TypedValue::Double(value),
        (ParamValue::String(text), _) => TypedValue::String(text),
        (ParamValue::Binary(bytes), _) => TypedValue::Bytes(bytes),
        (ParamValue::Map(_), _) => {
            return Err(CoerceError::Dictionary);
        }
    };
    Ok(natural)
}

fn coerce_list(items: Vec<ParamValue>, kind: ParameterKind) -> Result<TypedValue, CoerceError> {
    let by_kind = match kind {
        ParameterKind::Bytes => all(&items, byte).map(TypedValue::Bytes),
        ParameterKind::Bools => all(&items, bool).map(TypedValue::Bools),
        ParameterKind::Integers => all(&items, integer).map(TypedValue::Integers),
        ParameterKind::Doubles => all(&items, double).map(TypedValue::Doubles),
        ParameterKind::Strings => all(&items, text).map(TypedValue::Strings),
        _ => None,
    };
    if let Some(typed) = by_kind {
        return Ok(typed);
    }
    if items.is_empty() {
        return Err(CoerceError::EmptyList);
    }
    let whole = |item: &ParamValue| match item {
        ParamValue::Int(value) => Some(*value),
        _ => None,
    };
    all(&items, bool)
        .map(TypedValue::Bools)
        .or_else(|| all(&items, whole).map(TypedValue::Integers))
        .or_else(|| all(&items, double).map(TypedValue::Doubles))
        .or_else(|| all(&items, text).map(TypedValue::Strings))
        .ok_or(CoerceError::MixedList)
}

fn all<T>(items: &[ParamValue], one: impl Fn(&ParamValue) -> Option<T>) -> Option<Vec<T>> {
    items.iter().map(one).collect()
}

fn byte(item: &ParamValue) -> Option<u8> {
    integer(item).and_then(|value| u8::try_from(value).ok())
}

fn bool(item: &ParamValue) -> Option<bool> {
    match item {
        ParamValue::Bool(value) => Some(*value),
        _ => None,
    }
}

fn integer(item: &ParamValue) -> Option<i64> {
    match item {
        ParamValue::Int(value) => Some(*value),
        ParamValue::Double(value) if is_integer(*value) => Some(*value as i64),
        _ => None,
    }
}

fn double(item: &ParamValue) -> Option<f64> {
    match item {
        ParamValue::Double(value) => Some(*value),
        ParamValue::Int(value) if is_exact(*value) => Some(*value as f64),
        _ => None,
    }
}

fn text(item: &ParamValue) -> Option<String> {
    match item {
        ParamValue::String(text) => Some(text.clone()),
        _ => None,
    }
}

fn is_exact(value: i64) -> bool {
    value.unsigned_abs() <= EXACT
}

fn is_integer(value: f64) -> bool {
    value.fract() == 0.0 && value.abs() <= EXACT as f64
}

/// Writes a value.
pub fn write(value: &TypedValue, put: &mut CdrWriter) {
    use TypedValue::*;
    put.byte(number_from_kind(value.kind()));
    put.byte(u8::from(*value == Bool(true)));
    let integer = if let Integer(value) = value { *value } else { 0 };
    put.number(integer.to_le_bytes());
    let double = if let Double(value) = value { *value } else { 0.0 };
    put.number(double.to_le_bytes());
    put.text(if let String(text) = value { text } else { "" });
    let bytes: &[u8] = if let Bytes(bytes) = value { bytes } else { &[] };
    put.length(bytes.len());
    put.bytes(bytes);
    let bools: &[bool] = if let Bools(bools) = value { bools } else { &[] };
    put.length(bools.len());
    bools.iter().for_each(|one| put.byte(u8::from(*one)));
    let integers: &[i64] = if let Integers(all) = value { all } else { &[] };
    put.length(integers.len());
    integers.iter().for_each(|one| put.number(one.to_le_bytes()));
    let doubles: &[f64] = if let Doubles(all) = value { all } else { &[] };
    put.length(doubles.len());
    doubles.iter().for_each(|one| put.number(one.to_le_bytes()));
    let texts: &[std::string::String] = if let Strings(all) = value { all } else { &[] };
    put.length(texts.len());
    texts.iter().for_each(|one| put.text(one));
}

/// Reads a value; the inner `None` means that the parameter is not set.
pub fn read(reading: &mut ParameterReader<'_>) -> Option<Option<ParamValue>> {
    let kind = kind_from_number(reading.byte()?);
    let bool = reading.byte()? != 0;
    let integer = reading.integer()?;
    let double = reading.double()?;
    let text = reading.text_bytes()?;
    let bytes = reading.bytes()?;
    let bools = reading.bytes()?;
    let integers = reading.numbers()?;
    let doubles = reading.numbers()?;
    let texts = match kind {
        ParameterKind::Strings => Some(reading.texts()?),
        _ => reading.skip_texts().map(|()| None)?,
    };
    Some(match kind {
        ParameterKind::NotSet => None,
        ParameterKind::Bool => Some(ParamValue::Bool(bool)),
        ParameterKind::Integer => Some(ParamValue::Int(integer)),
        ParameterKind::Double => Some(ParamValue::Double(double)),
        ParameterKind::String => Some(ParamValue::String(lossy_text(text))),
        ParameterKind::Bytes => Some(ParamValue::Binary(bytes.to_vec())),
        ParameterKind::Bools => {
            reading.spend(bools.len())?;
            let bools = bools.iter().map(|byte| ParamValue::Bool(*byte != 0));
            Some(ParamValue::List(bools.collect()))
        }
        ParameterKind::Integers => {
            reading.spend(integers.len())?;
            let integers = integers.map(|number| ParamValue::Int(i64::from_le_bytes(number)));
            Some(ParamValue::List(integers.collect()))
        }
        ParameterKind::Doubles => {
            reading.spend(doubles.len())?;
            let doubles = doubles.map(|number| ParamValue::Double(f64::from_le_bytes(number)));
            Some(ParamValue::List(doubles.collect()))
        }
        ParameterKind::Strings => {
            let texts = texts.unwrap_or_default().into_iter();
            Some(ParamValue::List(texts.map(ParamValue::String).collect()))
        }
    })
}

/// Converts to text; invalid UTF-8 is replaced.
fn lossy_text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}
