//! Heads of CBOR items (RFC 8949, section 3).

/// Major types, shifted into place.
pub(crate) const UNSIGNED: u8 = 0 << 5;
pub(crate) const NEGATIVE: u8 = 1 << 5;
pub(crate) const BYTES: u8 = 2 << 5;
pub(crate) const TEXT: u8 = 3 << 5;
pub(crate) const ARRAY: u8 = 4 << 5;
pub(crate) const MAP: u8 = 5 << 5;
pub(crate) const TAG: u8 = 6 << 5;
/// Booleans, null, floats, and the break that ends items of indefinite length.
pub(crate) const SIMPLE: u8 = 7 << 5;

/// Writes an item's head in its shortest form.
#[inline]
pub(crate) fn write_head(out: &mut Vec<u8>, major: u8, value: u64) {
    match value {
        0..=23 => out.push(major | value as u8),
        24..=0xff => out.extend_from_slice(&[major | 24, value as u8]),
        0x100..=0xffff => {
            out.push(major | 25);
            out.extend_from_slice(&(value as u16).to_be_bytes());
        }
        0x1_0000..=0xffff_ffff => {
            out.push(major | 26);
            out.extend_from_slice(&(value as u32).to_be_bytes());
        }
        _ => {
            out.push(major | 27);
            out.extend_from_slice(&value.to_be_bytes());
        }
    }
}
