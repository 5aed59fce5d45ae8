//! Conversion of numbers between types of different range.

use ros_message::schema::Primitive;

/// Types of numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Number {
    Bool,
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
}

impl Number {
    pub(crate) fn from_primitive(primitive: Primitive) -> Option<Number> {
        Some(match primitive {
            Primitive::Bool => Number::Bool,
            Primitive::Int8 => Number::I8,
            Primitive::Uint8 => Number::U8,
            Primitive::Int16 => Number::I16,
            Primitive::Uint16 => Number::U16,
            Primitive::Int32 => Number::I32,
            Primitive::Uint32 => Number::U32,
            Primitive::Int64 => Number::I64,
            Primitive::Uint64 => Number::U64,
            Primitive::Float32 => Number::F32,
            Primitive::Float64 => Number::F64,
            Primitive::String | Primitive::Wstring | Primitive::Time | Primitive::Duration => return None,
        })
    }

    pub(crate) fn width(self) -> usize {
        match self {
            Number::Bool | Number::I8 | Number::U8 => 1,
            Number::I16 | Number::U16 => 2,
            Number::I32 | Number::U32 | Number::F32 => 4,
            Number::I64 | Number::U64 | Number::F64 => 8,
        }
    }

    fn is_float(self) -> bool {
        matches!(self, Number::F32 | Number::F64)
    }

    /// Returns true if numbers of one type are converted into the other: integers into integers, floats into floats.
    pub(crate) fn is_convertible_to(self, other: Number) -> bool {
        let is_bool = |number| number == Number::Bool;
        is_bool(self) == is_bool(other) && self.is_float() == other.is_float()
    }

    /// Returns the smallest and the largest integer.
    fn range(self) -> (i128, i128) {
        match self {
            Number::Bool => (0, 1),
            Number::I8 => (i8::MIN.into(), i8::MAX.into()),
            Number::U8 => (0, u8::MAX.into()),
            Number::I16 => (i16::MIN.into(), i16::MAX.into()),
            Number::U16 => (0, u16::MAX.into()),
            Number::I32 => (i32::MIN.into(), i32::MAX.into()),
            Number::U32 => (0, u32::MAX.into()),
            Number::I64 => (i64::MIN.into(), i64::MAX.into()),
            Number::U64 | Number::F32 | Number::F64 => (0, u64::MAX.into()),
        }
    }
}

/// Converts a number, given and returned as little-endian bytes of which only the type's width counts. Returns true
/// beside it if the number did not fit and the nearest one stands in its place. Any byte but 0 is a true bool.
pub(crate) fn convert(from: Number, to: Number, bytes: [u8; 8]) -> ([u8; 8], bool) {
    if from == Number::Bool {
        return ([u8::from(bytes[0] != 0), 0, 0, 0, 0, 0, 0, 0], false);
    }
    if from.is_float() {
        return convert_float(from, to, bytes);
    }
    let bits = u64::from_le_bytes(bytes);
    let unused = 64 - 8 * from.width() as u32;
    let signed = from.range().0 < 0;
    let value = if signed { i128::from((bits << unused) as i64 >> unused) } else { (bits << unused >> unused).into() };
    let (low, high) = to.range();
    let fitting = value.clamp(low, high);
    // Two's complement: the low bytes are the same for any width.
    ((fitting as u64).to_le_bytes(), fitting != value)
}

fn convert_float(from: Number, to: Number, bytes: [u8; 8]) -> ([u8; 8], bool) {
    let [a, b, c, d, ..] = bytes;
    let single = f32::from_le_bytes([a, b, c, d]);
    let double = if from == Number::F32 { single.into() } else { f64::from_le_bytes(bytes) };
    if to == Number::F64 {
        return (double.to_le_bytes(), false);
    }
    let rounded = double as f32;
    let beyond = rounded.is_infinite() && double.is_finite();
    let fitting = if beyond { f32::MAX.copysign(rounded) } else { rounded };
    let [a, b, c, d] = fitting.to_le_bytes();
    ([a, b, c, d, 0, 0, 0, 0], beyond)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn integer(from: Number, to: Number, value: i64) -> (i64, bool) {
        let (bytes, saturated) = convert(from, to, value.to_le_bytes());
        let unused = 64 - 8 * to.width() as u32;
        let bits = u64::from_le_bytes(bytes) << unused;
        let signed = to.range().0 < 0;
        (if signed { bits as i64 >> unused } else { (bits >> unused) as i64 }, saturated)
    }

    #[test]
    fn integers_out_of_range_become_the_nearest() {
        for (from, to, value, expected) in [
            (Number::I8, Number::U8, -1, (0, true)),
            (Number::U8, Number::I8, 200, (127, true)),
            (Number::I32, Number::I16, -70_000, (-32_768, true)),
            (Number::I16, Number::I64, -5, (-5, false)),
            (Number::U32, Number::I32, 7, (7, false)),
            (Number::U64, Number::I64, -1, (i64::MAX, true)),
            (Number::I64, Number::U32, 1 << 40, (u32::MAX.into(), true)),
        ] {
            assert_eq!(integer(from, to, value), expected, "{from:?} {to:?} {value}");
        }
        assert_eq!(convert(Number::Bool, Number::Bool, [7; 8]).0[0], 1);
    }

    #[test]
    fn floats_are_rounded_and_stay_finite() {
        let narrow = |value: f64| {
            let (bytes, saturated) = convert(Number::F64, Number::F32, value.to_le_bytes());
            let [a, b, c, d, ..] = bytes;
            (f32::from_le_bytes([a, b, c, d]), saturated)
        };
        assert_eq!(narrow(0.1), (0.1, false));
        assert_eq!(narrow(-1e300), (f32::MIN, true));
        assert_eq!(narrow(f64::INFINITY), (f32::INFINITY, false));
        assert!(narrow(f64::NAN).0.is_nan());
        let mut single = [0; 8];
        single[..4].copy_from_slice(&0.5f32.to_le_bytes());
        assert_eq!(convert(Number::F32, Number::F64, single), (0.5f64.to_le_bytes(), false));
        assert!(!Number::I32.is_convertible_to(Number::F32) && !Number::Bool.is_convertible_to(Number::U8));
    }
}
