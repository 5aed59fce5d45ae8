//! ROS 2's serialization: CDR, in the version that DDS calls plain XCDR1 (OMG DDS-XTypes 1.3, section 7.4.1), in either
//! byte order.
//!
//! ```text
//! 00 REPRESENTATION 00 00 | body: each number at a multiple of its size, counted from the body's beginning
//! ```
//!
//! As produced by rosidl and Fast DDS on the wire: the length of a string includes the terminating NUL; a wide string
//! consists of UTF-16 code units of four bytes each, without a NUL; an empty sequence of wide numbers has no padding
//! after its length; a type without fields is one byte of any value. Padding has any value too, and bytes may follow
//! the message, because a sender that serializes into a buffer of estimated size leaves them there: nodes ignore them,
//! and so does this code.

use crate::codec::fault::{CodecErrorKind, Fault};
use crate::codec::reader::{SerializedReader, check_length};
use crate::schema::plan::{CodecPlan, Count, Scalar, Text};

/// Encapsulation header written before the body: little endian.
pub(crate) const HEADER: [u8; 4] = [0, 1, 0, 0];

/// Bytes per unit of a wide string.
pub(crate) const WIDE: usize = 4;

/// Returns the body, and whether it is big endian.
pub(crate) fn split_header(bytes: &[u8]) -> Result<(&[u8], bool), Fault> {
    let Some((header, body)) = bytes.split_first_chunk::<4>() else {
        let missing = HEADER.len() - bytes.len();
        return Err(CodecErrorKind::Truncated { missing }.into());
    };
    match header {
        [0, 0, ..] => Ok((body, true)),
        [0, 1, ..] => Ok((body, false)),
        [first, second, ..] => {
            let found = u16::from_be_bytes([*first, *second]);
            Err(CodecErrorKind::Representation(found).into())
        }
    }
}

/// Reads values from a body; `BIG` selects the byte order.
pub(crate) struct Cdr<'a, const BIG: bool> {
    body: &'a [u8],
    at: usize,
    /// A scalar, byte-swapped.
    one: [u8; 8],
    /// A byte-swapped array, or wide text as UTF-8; grows as large as the largest one read.
    turned: Vec<u8>,
}

impl<'a, const BIG: bool> Cdr<'a, BIG> {
    pub(crate) fn new(body: &'a [u8]) -> Self {
        Cdr { body, at: 0, one: [0; 8], turned: Vec::new() }
    }

    /// Skips padding and takes `size` bytes. `alignment` is a power of two.
    #[inline]
    fn take_aligned(&mut self, size: usize, alignment: usize) -> Result<&'a [u8], Fault> {
        let begin = (self.at + alignment - 1) & !(alignment - 1);
        let end = begin.saturating_add(size);
        let Some(taken) = self.body.get(begin..end) else {
            return Err(CodecErrorKind::Truncated { missing: end - self.body.len() }.into());
        };
        self.at = end;
        Ok(taken)
    }

    #[inline]
    fn word(&mut self) -> Result<usize, Fault> {
        let mut word = [0; 4];
        word.copy_from_slice(self.take_aligned(4, 4)?);
        Ok(self::word::<BIG>(word) as usize)
    }

    fn remaining(&self) -> usize {
        self.body.len() - self.at
    }

    fn wide_text(&mut self) -> Result<&[u8], Fault> {
        let length = self.length(Count::Variable, WIDE)?;
        let units = self.take_aligned(length * WIDE, WIDE)?;
        self.turned.clear();
        push_utf8::<BIG>(units, &mut self.turned);
        Ok(&self.turned)
    }
}

/// Converts the units of a wide string to UTF-8.
pub(crate) fn units_to_utf8<const BIG: bool>(units: &[u8]) -> Vec<u8> {
    let mut text = Vec::new();
    push_utf8::<BIG>(units, &mut text);
    text
}

fn push_utf8<const BIG: bool>(units: &[u8], out: &mut Vec<u8>) {
    let mut units = units.chunks_exact(WIDE).map(|unit| {
        let mut bytes = [0; WIDE];
        bytes.copy_from_slice(unit);
        word::<BIG>(bytes)
    });
    let mut next = units.next();
    while let Some(unit) = next {
        next = units.next();
        let character = match (unit, next) {
            (0xd800..0xdc00, Some(low @ 0xdc00..0xe000)) => {
                next = units.next();
                char::from_u32(0x1_0000 + ((unit - 0xd800) << 10) + (low - 0xdc00))
            }
            _ => char::from_u32(unit),
        };
        match character {
            Some(character) => {
                out.extend_from_slice(character.encode_utf8(&mut [0; 4]).as_bytes());
            }
            // Not representable in UTF-8: replaced or refused later, like any invalid byte.
            None => out.push(0xff),
        }
    }
}

#[inline]
fn word<const BIG: bool>(bytes: [u8; 4]) -> u32 {
    if BIG { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) }
}

impl<const BIG: bool> SerializedReader for Cdr<'_, BIG> {
    const PLACEHOLDERS: bool = true;

    #[inline]
    fn scalar(&mut self, scalar: Scalar) -> Result<&[u8], Fault> {
        let (size, alignment) = (scalar.size(), scalar.alignment());
        let bytes = self.take_aligned(size, alignment)?;
        if !BIG {
            return Ok(bytes);
        }
        let one = &mut self.one[..size];
        one.copy_from_slice(bytes);
        for number in one.chunks_exact_mut(alignment) {
            number.reverse();
        }
        Ok(one)
    }

    fn scalars(&mut self, scalar: Scalar, length: usize) -> Result<&[u8], Fault> {
        if length == 0 {
            return Ok(&[]);
        }
        let alignment = scalar.alignment();
        let bytes = self.take_aligned(length * scalar.size(), alignment)?;
        if !BIG || alignment == 1 {
            return Ok(bytes);
        }
        self.turned.clear();
        self.turned.extend_from_slice(bytes);
        for number in self.turned.chunks_exact_mut(alignment) {
            number.reverse();
        }
        Ok(&self.turned)
    }

    #[inline]
    fn take(&mut self, size: usize) -> Result<&[u8], Fault> {
        self.take_aligned(size, 1)
    }

    #[inline]
    fn text(&mut self, text: Text) -> Result<&[u8], Fault> {
        if text.wide {
            return self.wide_text();
        }
        let length = self.length(Count::Variable, 1)?;
        let bytes = self.take_aligned(length, 1)?;
        // Nodes also accept a string without its NUL.
        Ok(bytes.strip_suffix(&[0]).unwrap_or(bytes))
    }

    #[inline]
    fn length(&mut self, count: Count, min_size: usize) -> Result<usize, Fault> {
        let length = match count {
            Count::Fixed(length) => length,
            Count::Variable | Count::Bounded(_) => self.word()?,
        };
        check_length(count, length, min_size, self.remaining())?;
        Ok(length)
    }

    /// Messages cannot be skipped as a block: the padding depends on where a message begins.
    #[inline]
    fn skip(&mut self, _: &CodecPlan, _: usize) -> Result<bool, Fault> {
        Ok(false)
    }

    fn trailing(&self) -> usize {
        0
    }
}
