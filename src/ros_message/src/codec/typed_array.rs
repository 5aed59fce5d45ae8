//! CBOR typed arrays (RFC 8746): tags 64 to 87, each for one kind, width and byte order of numbers.

use crate::codec::cbor_item::ItemHead;
use crate::codec::fault::Fault;
use crate::codec::number::{Number, Wire};
use crate::schema::plan::Scalar;

/// Returns the tag for the bytes of a ROS array as they are.
pub(crate) fn little_endian_tag(scalar: Scalar) -> Option<u64> {
    Some(match scalar {
        Scalar::U8 => 64,
        Scalar::U16 => 69,
        Scalar::U32 => 70,
        Scalar::U64 => 71,
        Scalar::I8 => 72,
        Scalar::I16 => 77,
        Scalar::I32 => 78,
        Scalar::I64 => 79,
        Scalar::F32 => 85,
        Scalar::F64 => 86,
        Scalar::Bool | Scalar::Time | Scalar::Duration | Scalar::Time2 | Scalar::Duration2 => {
            return None;
        }
    })
}

/// Element format denoted by a tag.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ElementLayout {
    float: bool,
    signed: bool,
    little_endian: bool,
    /// Bytes per element.
    pub(crate) width: usize,
}

impl ElementLayout {
    /// Decodes a tag by RFC 8746 section 2.1: `0b010_fsell`. Quadruple floats are not supported.
    pub(crate) fn from_tag(tag: u64) -> Option<ElementLayout> {
        if !(64..=87).contains(&tag) || matches!(tag, 76 | 83 | 87) {
            return None;
        }
        let (float, signed) = (tag & 16 != 0, tag & 8 != 0);
        let exponent = (tag & 3) as u32 + u32::from(float);
        // 68 is clamped uint8, which has no byte order.
        Some(ElementLayout { float, signed, little_endian: tag & 4 != 0, width: 1 << exponent })
    }

    /// Appends the elements, converted to `T`.
    pub(crate) fn append<T: Wire>(self, tag: u64, bytes: &[u8], out: &mut Vec<u8>) -> Result<(), Fault> {
        let same = little_endian_tag(T::SCALAR) == Some(tag) || (tag == 68 && T::SCALAR == Scalar::U8);
        if same {
            out.extend_from_slice(bytes);
            return Ok(());
        }
        out.reserve(bytes.len() / self.width * T::SCALAR.size());
        for (index, element) in bytes.chunks_exact(self.width).enumerate() {
            T::from_number(self.number(element)).map_err(|fault| fault.at_index(index))?.put(out);
        }
        Ok(())
    }

    fn number(self, element: &[u8]) -> Number {
        let mut wide = [0; 8];
        wide[..self.width].copy_from_slice(element);
        if !self.little_endian {
            wide[..self.width].reverse();
        }
        let bits = u64::from_le_bytes(wide);
        if self.float {
            return Number::Float(bits_to_float(self.width, bits));
        }
        let unused = 64 - 8 * self.width as u32;
        match ((bits << unused) as i64) >> unused {
            negative if self.signed && negative < 0 => Number::Negative(!negative as u64),
            _ => Number::Unsigned(bits),
        }
    }
}

/// Returns the float that a head of major type 7 carries; `None` if it carries none.
pub(crate) fn head_to_float(head: ItemHead) -> Option<f64> {
    matches!(head.info, 25..=27).then(|| bits_to_float(1 << (head.info - 24), head.value))
}

fn bits_to_float(width: usize, bits: u64) -> f64 {
    match width {
        2 => half(bits as u16),
        4 => f32::from_bits(bits as u32).into(),
        _ => f64::from_bits(bits),
    }
}

/// Converts IEEE 754 half precision; every half is exactly representable as a double.
fn half(bits: u16) -> f64 {
    let mantissa = f64::from(bits & 0x3ff);
    let magnitude = match bits >> 10 & 0x1f {
        0 => mantissa * 2f64.powi(-24),
        31 if mantissa == 0.0 => f64::INFINITY,
        31 => f64::NAN,
        exponent => (mantissa + 1024.0) * 2f64.powi(i32::from(exponent) - 25),
    };
    if bits >> 15 == 0 { magnitude } else { -magnitude }
}
