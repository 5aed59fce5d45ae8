//! Conversion of input numbers to ROS numbers, with errors.

use crate::codec::fault::{CodecErrorKind, Fault, mismatch};
use crate::codec::float::{double, single};
use crate::schema::plan::Scalar;

/// A number in CBOR.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Number {
    Unsigned(u64),
    /// Represents `-1 - n`.
    Negative(u64),
    Float(f64),
}

/// A number in JSON, parsed but not yet converted: (-1)^negative * mantissa * 10^exponent.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Decimal<'a> {
    pub(crate) negative: bool,
    pub(crate) mantissa: u64,
    pub(crate) exponent: i64,
    /// True if there are more digits than `mantissa` holds.
    pub(crate) truncated: bool,
    /// True if there is neither fraction nor exponent.
    pub(crate) integral: bool,
    /// The complete number, in JSON's grammar.
    pub(crate) text: &'a [u8],
}

impl Decimal<'_> {
    /// Returns the number as written in the input.
    #[cold]
    fn as_written(self) -> String {
        String::from_utf8_lossy(self.text).into_owned()
    }
}

/// A numeric type of ROS.
pub(crate) trait Wire: Copy + 'static {
    const SCALAR: Scalar;
    const NAME: &'static str;
    fn from_decimal(decimal: &Decimal<'_>) -> Result<Self, Fault>;
    fn from_number(number: Number) -> Result<Self, Fault>;
    /// Converts NaN or an infinity; `None` for types that have none.
    fn from_non_finite(value: f64) -> Option<Self>;
    /// Appends the number, little endian.
    fn put(self, out: &mut Vec<u8>);
}

macro_rules! integers {
    ($($type:ty, $scalar:ident, $name:literal;)*) => {$(
        impl Wire for $type {
            const SCALAR: Scalar = Scalar::$scalar;
            const NAME: &'static str = $name;

            #[inline]
            fn from_decimal(decimal: &Decimal<'_>) -> Result<Self, Fault> {
                if !decimal.integral || decimal.truncated {
                    return from_written::<$type>(decimal);
                }
                let value = if decimal.negative {
0i64.checked_sub_unsigned(decimal.mantissa).and_then(|value| value.try_into().ok())
} else {
<$type>::try_from(decimal.mantissa).ok()
};
                value.ok_or_else(|| out_of_range::<$type>(decimal.as_written()))
            }

            #[inline]
            fn from_number(number: Number) -> Result<Self, Fault> {
                let value = match number {
                    Number::Unsigned(value) => <$type>::try_from(value).ok(),
                    Number::Negative(value) => {
                        i64::try_from(value).ok().and_then(|value| <$type>::try_from(!value).ok())
                    }
                    Number::Float(value) => {
                        if value.is_finite() && value.fract() != 0.0 {
                            return Err(mismatch($name, "a number with a fraction"));
                        }
                        // The upper bound rounds up to a power of two, one above the maximum.
                        let fits = value >= <$type>::MIN as f64 && value < <$type>::MAX as f64 + 1.0;
                        fits.then_some(value as $type)
                    }
                };
                value.ok_or_else(|| out_of_range::<$type>(describe(number)))
            }

            fn from_non_finite(_: f64) -> Option<Self> {
                None
            }

            #[inline]
            fn put(self, out: &mut Vec<u8>) {
                out.extend_from_slice(&self.to_le_bytes());
            }
        }
    )*};
}

integers! {
    i8, I8, "int8";
    u8, U8, "uint8";
    i16, I16, "int16";
    u16, U16, "uint16";
    i32, I32, "int32";
    u32, U32, "uint32";
    i64, I64, "int64";
    u64, U64, "uint64";
}

macro_rules! floats {
    ($($type:ty, $scalar:ident, $name:literal, $convert:ident;)*) => {$(
        impl Wire for $type {
            const SCALAR: Scalar = Scalar::$scalar;
            const NAME: &'static str = $name;

            #[inline]
            fn from_decimal(decimal: &Decimal<'_>) -> Result<Self, Fault> {
                match $convert(decimal) {
                    value if value.is_finite() => Ok(value),
                    _ => Err(out_of_range::<$type>(decimal.as_written())),
                }
            }

            #[inline]
            fn from_number(number: Number) -> Result<Self, Fault> {
                let value = match number {
                    Number::Unsigned(value) => value as $type,
                    Number::Negative(value) => -1.0 - value as $type,
                    Number::Float(wide) => {
                        let value = wide as $type;
                        if wide.is_finite() && !value.is_finite() {
                            return Err(out_of_range::<$type>(describe(number)));
                        }
                        value
                    }
                };
                Ok(value)
            }

            fn from_non_finite(value: f64) -> Option<Self> {
                Some(value as $type)
            }

            #[inline]
            fn put(self, out: &mut Vec<u8>) {
                out.extend_from_slice(&self.to_le_bytes());
            }
        }
    )*};
}

floats! {
    f32, F32, "float32", single;
    f64, F64, "float64", double;
}

/// Converts an integer in another notation: `1.0`, `1e3`, or with very many digits.
#[cold]
fn from_written<T: Wire>(decimal: &Decimal<'_>) -> Result<T, Fault> {
    match T::from_number(Number::Float(double(decimal))) {
        Ok(value) if !decimal.integral => Ok(value),
        Err(fault) if !fault.is_out_of_range() => Err(fault),
        _ => Err(out_of_range::<T>(decimal.as_written())),
    }
}

#[cold]
fn out_of_range<T: Wire>(mut found: String) -> Fault {
    // A number may be megabytes of digits, all of them ASCII.
    if found.len() > 40 {
        found.truncate(40);
        found.push('…');
    }
    CodecErrorKind::OutOfRange { expected: T::NAME, found }.into()
}

#[cold]
fn describe(number: Number) -> String {
    match number {
        Number::Unsigned(value) => value.to_string(),
        Number::Negative(value) => (-1 - i128::from(value)).to_string(),
        Number::Float(value) => value.to_string(),
    }
}
