//! Conversion of numbers between types of different range.

use ros_message::schema::Primitive;

/// A built-in type that is a number or a bool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Number(Primitive);

impl Number {
    pub(crate) const BOOL: Number = Number(Primitive::Bool);

    pub(crate) fn from_primitive(primitive: Primitive) -> Option<Number> {
        let is_other =
            matches!(primitive, Primitive::String | Primitive::Wstring | Primitive::Time | Primitive::Duration);
        (!is_other).then_some(Number(primitive))
    }

    pub(crate) fn width(self) -> usize {
        self.0.size()
    }

    fn is_float(self) -> bool {
        matches!(self.0, Primitive::Float32 | Primitive::Float64)
    }

    /// Returns true if numbers of one type are converted into the other: integers into integers, floats into floats.
    pub(crate) fn is_convertible_to(self, other: Number) -> bool {
        (self == Number::BOOL) == (other == Number::BOOL) && self.is_float() == other.is_float()
    }

    /// Returns the smallest and the largest integer.
    fn range(self) -> (i128, i128) {
        match self.0 {
            Primitive::Bool => (0, 1),
            Primitive::Int8 => (i8::MIN.into(), i8::MAX.into()),
            Primitive::Int16 => (i16::MIN.into(), i16::MAX.into()),
            Primitive::Int32 => (i32::MIN.into(), i32::MAX.into()),
            Primitive::Int64 => (i64::MIN.into(), i64::MAX.into()),
            Primitive::Uint8 => (0, u8::MAX.into()),
            Primitive::Uint16 => (0, u16::MAX.into()),
            Primitive::Uint32 => (0, u32::MAX.into()),
            _ => (0, u64::MAX.into()),
        }
    }
}

/// Converts a number, given and returned as little-endian bytes of which only the type's width counts. Returns true
/// beside it if the number did not fit and the nearest one stands in its place. Any byte but 0 is a true bool.
pub(crate) fn convert(from: Number, to: Number, bytes: [u8; 8]) -> ([u8; 8], bool) {
    if from == Number::BOOL {
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
    let double = if from.0 == Primitive::Float32 { single.into() } else { f64::from_le_bytes(bytes) };
    if to.0 == Primitive::Float64 {
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
            (Number(Primitive::Int8), Number(Primitive::Uint8), -1, (0, true)),
            (Number(Primitive::Uint8), Number(Primitive::Int8), 200, (127, true)),
            (Number(Primitive::Int32), Number(Primitive::Int16), -70_000, (-32_768, true)),
            (Number(Primitive::Int16), Number(Primitive::Int64), -5, (-5, false)),
            (Number(Primitive::Uint32), Number(Primitive::Int32), 7, (7, false)),
            (Number(Primitive::Uint64), Number(Primitive::Int64), -1, (i64::MAX, true)),
            (Number(Primitive::Int64), Number(Primitive::Uint32), 1 << 40, (u32::MAX.into(), true)),
        ] {
            assert_eq!(integer(from, to, value), expected, "{from:?} {to:?} {value}");
        }
        assert_eq!(convert(Number::BOOL, Number::BOOL, [7; 8]).0[0], 1);
    }

    #[test]
    fn floats_are_rounded_and_stay_finite() {
        let narrow = |value: f64| {
            let (bytes, saturated) =
                convert(Number(Primitive::Float64), Number(Primitive::Float32), value.to_le_bytes());
            let [a, b, c, d, ..] = bytes;
            (f32::from_le_bytes([a, b, c, d]), saturated)
        };
        assert_eq!(narrow(0.1), (0.1, false));
        assert_eq!(narrow(-1e300), (f32::MIN, true));
        assert_eq!(narrow(f64::INFINITY), (f32::INFINITY, false));
        assert!(narrow(f64::NAN).0.is_nan());
        let mut single = [0; 8];
        single[..4].copy_from_slice(&0.5f32.to_le_bytes());
        assert_eq!(
            convert(Number(Primitive::Float32), Number(Primitive::Float64), single),
            (0.5f64.to_le_bytes(), false)
        );
        assert!(
            !Number(Primitive::Int32).is_convertible_to(Number(Primitive::Float32))
                && !Number::BOOL.is_convertible_to(Number(Primitive::Uint8))
        );
    }
}
