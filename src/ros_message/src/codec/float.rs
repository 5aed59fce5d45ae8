//! Conversion of decimals to binary floating point, correctly rounded. Numbers of up to 15 or so digits, which is
//! nearly all, take one exact multiplication or division (Clinger, "How to read floating point numbers accurately",
//! 1990); the rest is left to the standard library.

use std::str::FromStr;

use crate::codec::number::Decimal;

const POWERS: [f64; 23] = [
    1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19, 1e20,
    1e21, 1e22,
];

/// Returns the nearest double; infinite when out of range.
#[inline]
pub(crate) fn double(decimal: &Decimal<'_>) -> f64 {
    match exact(decimal) {
        Some(value) => value,
        None => parse(decimal).unwrap_or(f64::INFINITY),
    }
}

/// Returns the nearest single; infinite when out of range.
#[inline]
pub(crate) fn single(decimal: &Decimal<'_>) -> f32 {
    if let Some(value) = exact(decimal) {
        // Rounding twice is wrong only if the first rounding landed half-way between two singles (and for subnormals,
        // whose half-way points are elsewhere).
        const DROPPED: u64 = (1 << 29) - 1;
        let half_way = value.to_bits() & DROPPED == 1 << 28;
        if value == 0.0 || (!half_way && value.abs() >= f64::from(f32::MIN_POSITIVE)) {
            return value as f32;
        }
    }
    parse(decimal).unwrap_or(f32::INFINITY)
}

/// Parses with the standard library, whose grammar includes JSON's.
#[inline(never)]
fn parse<T: FromStr>(decimal: &Decimal<'_>) -> Option<T> {
    std::str::from_utf8(decimal.text).ok()?.parse().ok()
}

/// Returns the value if mantissa and power of ten are both exact doubles: then their product or quotient is rounded
/// once, that is correctly.
#[inline]
fn exact(decimal: &Decimal<'_>) -> Option<f64> {
    if decimal.truncated {
        return None;
    }
    let magnitude = match decimal.exponent {
        0 => decimal.mantissa as f64,
        _ if decimal.mantissa > 1 << 53 => return None,
        exponent @ 1..=22 => decimal.mantissa as f64 * POWERS[exponent as usize],
        exponent @ -22..=-1 => decimal.mantissa as f64 / POWERS[-exponent as usize],
        _ => return None,
    };
    Some(if decimal.negative { -magnitude } else { magnitude })
}
