//! Texts: bytes in ROS 1, bytes with a NUL at their end or UTF-16 units of four bytes each in ROS 2.

use ros_message::codec::{CodecErrorKind, Fault};

/// Serialized forms of texts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum TextForm {
    /// ROS 1.
    Packed,
    /// ROS 2's `string`.
    Terminated,
    /// ROS 2's `wstring`.
    Wide,
}

const REPLACEMENT: char = char::REPLACEMENT_CHARACTER;

/// Checks the bound of a definition. Bytes that are not UTF-8 count as nodes count them: those that begin a character.
pub(crate) fn check_bound(bytes: &[u8], most: Option<usize>) -> Result<(), Fault> {
    let Some(most) = most else {
        return Ok(());
    };
    let found = bytes.iter().filter(|byte| **byte & 0xc0 != 0x80).count();
    if found > most {
        return Err(CodecErrorKind::TooMany { most, of: "characters", found }.into());
    }
    Ok(())
}

/// Appends the UTF-16 units of a text, little endian, each in four bytes. Returns the number of units, and of byte
/// sequences that are not UTF-8 and were replaced by U+FFFD.
pub(crate) fn push_units(bytes: &[u8], out: &mut Vec<u8>) -> (usize, u64) {
    let (mut units, mut replaced) = (0, 0);
    let mut push = |character: char| {
        for unit in character.encode_utf16(&mut [0; 2]) {
            out.extend_from_slice(&u32::from(*unit).to_le_bytes());
            units += 1;
        }
    };
    for chunk in bytes.utf8_chunks() {
        chunk.valid().chars().for_each(&mut push);
        if !chunk.invalid().is_empty() {
            push(REPLACEMENT);
            replaced += 1;
        }
    }
    (units, replaced)
}

/// Appends UTF-16 units as UTF-8. Returns the number of units that are no text and were replaced by U+FFFD.
pub(crate) fn push_utf8(units: impl Iterator<Item = u32>, out: &mut Vec<u8>) -> u64 {
    let mut units = units.peekable();
    let mut replaced = 0;
    while let Some(unit) = units.next() {
        let low = units.peek().copied().filter(|low| (0xdc00..0xe000).contains(low));
        let character = match (unit, low) {
            (0xd800..0xdc00, Some(low)) => {
                units.next();
                char::from_u32(0x1_0000 + ((unit - 0xd800) << 10) + (low - 0xdc00))
            }
            _ => char::from_u32(unit),
        };
        replaced += u64::from(character.is_none());
        let character = character.unwrap_or(REPLACEMENT);
        out.extend_from_slice(character.encode_utf8(&mut [0; 4]).as_bytes());
    }
    replaced
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_and_bytes_say_the_same() {
        let text = "a机🤖\0z";
        let mut wide = Vec::new();
        assert_eq!(push_units(text.as_bytes(), &mut wide), (6, 0));
        let units = |wide: &[u8]| -> Vec<u32> {
            wide.chunks_exact(4).map(|unit| u32::from_le_bytes(unit.try_into().unwrap())).collect()
        };
        let mut narrow = Vec::new();
        assert_eq!(push_utf8(units(&wide).into_iter(), &mut narrow), 0);
        assert_eq!(narrow, text.as_bytes());
    }

    #[test]
    fn what_is_no_text_is_replaced_and_counted() {
        let mut wide = Vec::new();
        assert_eq!(push_units(b"a\xffb\xc3", &mut wide), (4, 2));
        let mut narrow = Vec::new();
        assert_eq!(push_utf8([0xd800, 0x61, 0xdc00, 0xd83e, u32::MAX].into_iter(), &mut narrow), 4);
        assert_eq!(narrow, "\u{fffd}a\u{fffd}\u{fffd}\u{fffd}".as_bytes());
    }

    #[test]
    fn bounds_count_characters() {
        assert!(check_bound("äöü".as_bytes(), Some(3)).is_ok() && check_bound(b"abcd", None).is_ok());
        assert!(check_bound(b"abcd", Some(3)).is_err());
    }
}
