//! Conversion of decimal digits to integers.

/// Returns the value of eight digits, computed in parallel: pairs, then groups of four, then both halves.
#[inline]
pub(crate) fn eight_digits(chunk: [u8; 8]) -> Option<u64> {
    const ONES: u64 = u64::MAX / 255;
    let word = u64::from_le_bytes(chunk);
    let digits = word.wrapping_sub(ONES * u64::from(b'0'));
    // Adding 0x46 carries '9' + 1 and above into the high bit, subtracting '0' borrows from below '0' into it.
    if (word.wrapping_add(ONES * 0x46) | digits) & (ONES * 0x80) != 0 {
        return None;
    }
    let pairs = (digits * 10 + (digits >> 8)) & 0x00ff_00ff_00ff_00ff;
    let fours = (pairs * 100 + (pairs >> 16)) & 0x0000_ffff_0000_ffff;
    Some((fours * 10_000 + (fours >> 32)) & 0xffff_ffff)
}

/// Returns the mantissa of a number of 20 digits or more, and whether it overflowed.
#[cold]
pub(crate) fn many_digits(text: &[u8]) -> (u64, bool) {
    let mut digits = text.iter().filter(|byte| byte.is_ascii_digit());
    let value = digits.try_fold(0u64, |value, digit| value.checked_mul(10)?.checked_add(u64::from(digit - b'0')));
    (value.unwrap_or_default(), value.is_none())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eight_digits_or_none() {
        assert_eq!(eight_digits(*b"12345678"), Some(12_345_678));
        assert_eq!(eight_digits(*b"00000000"), Some(0));
        assert_eq!(eight_digits(*b"99999999"), Some(99_999_999));
        for at in 0..8 {
            for byte in (0..=255u8).filter(|byte| !byte.is_ascii_digit()) {
                let mut chunk = *b"09182736";
                chunk[at] = byte;
                assert_eq!(eight_digits(chunk), None, "{byte} at {at}");
            }
        }
    }

    #[test]
    fn many_digits_to_the_last_that_fits() {
        assert_eq!(many_digits(b"-18446744073709551615"), (u64::MAX, false));
        assert_eq!(many_digits(b"0.00000000000000000000012"), (12, false));
        assert!(many_digits(b"18446744073709551616").1);
    }
}
