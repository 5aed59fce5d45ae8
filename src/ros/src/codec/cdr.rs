//! ROS 2's bytes: CDR, as DDS calls the first version of it (XCDR1, plain; OMG DDS-XTypes 1.3, section 7.4.1), in either
//! order of bytes.
//!
//! ```text
//! 00 REPRESENTATION 00 00 | body: each number at a multiple of its size, counted from the body's beginning
//! ```
//!
//! What rosidl and Fast DDS make of it, seen on the wire: a string's length counts the NUL behind it; a wide string is
//! units of UTF-16 of four bytes each, without one; an empty sequence of wide numbers has no padding behind its length;
//! a type without fields is one byte of any value. What pads is of any value too, and bytes may follow the message,
//! because who serializes by an estimated size leaves them there: nodes do not look at them, nor does this.

use crate::codec::fault::{CodecErrorKind, Fault};
use crate::codec::reader::{Reader, check_length};
use crate::schema::plan::{Count, Plan, Scalar, Text};

/// What stands before the body of what is written here: little endian.
pub(crate) const HEADER: [u8; 4] = [0, 1, 0, 0];

/// Bytes of one unit of a wide string.
pub(crate) const WIDE: usize = 4;

/// The body, and whether its numbers are big endian.
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

/// Takes values out of a body; `BIG` endian or little.
pub(crate) struct Cdr<'a, const BIG: bool> {
    body: &'a [u8],
    at: usize,
    /// A scalar with its bytes turned round.
    one: [u8; 8],
    /// An array with its bytes turned round, or wide text as UTF-8: as large as what it was made of.
    turned: Vec<u8>,
}

impl<'a, const BIG: bool> Cdr<'a, BIG> {
    pub(crate) fn new(body: &'a [u8]) -> Self {
        Cdr {
            body,
            at: 0,
            one: [0; 8],
            turned: Vec::new(),
        }
    }

    /// `alignment` is a power of two.
    #[inline]
    fn aligned(&mut self, size: usize, alignment: usize) -> Result<&'a [u8], Fault> {
        let begin = (self.at + alignment - 1) & !(alignment - 1);
        let end = begin.saturating_add(size);
        let Some(taken) = self.body.get(begin..end) else {
            return Err(CodecErrorKind::Truncated {
                missing: end - self.body.len(),
            }
            .into());
        };
        self.at = end;
        Ok(taken)
    }

    #[inline]
    fn word(&mut self) -> Result<usize, Fault> {
        let mut word = [0; 4];
        word.copy_from_slice(self.aligned(4, 4)?);
        Ok(self::word::<BIG>(word) as usize)
    }

    fn left(&self) -> usize {
        self.body.len() - self.at
    }

    fn wide_text(&mut self) -> Result<&[u8], Fault> {
        let length = self.length(Count::Variable, WIDE)?;
        let units = self.aligned(length * WIDE, WIDE)?;
        self.turned.clear();
        push_utf8::<BIG>(units, &mut self.turned);
        Ok(&self.turned)
    }
}

/// Units of a wide string as UTF-8.
pub(crate) fn utf8_of<const BIG: bool>(units: &[u8]) -> Vec<u8> {
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
            // No UTF-8 has it, so it is replaced or refused as such bytes are.
            None => out.push(0xff),
        }
    }
}

#[inline]
fn word<const BIG: bool>(bytes: [u8; 4]) -> u32 {
    match BIG {
        true => u32::from_be_bytes(bytes),
        false => u32::from_le_bytes(bytes),
    }
}

impl<const BIG: bool> Reader for Cdr<'_, BIG> {
    const PLACEHOLDERS: bool = true;

    #[inline]
    fn scalar(&mut self, scalar: Scalar) -> Result<&[u8], Fault> {
        let (size, alignment) = (scalar.size(), scalar.alignment());
        let bytes = self.aligned(size, alignment)?;
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
        let bytes = self.aligned(length * scalar.size(), alignment)?;
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
        self.aligned(size, 1)
    }

    #[inline]
    fn text(&mut self, text: Text) -> Result<&[u8], Fault> {
        if text.wide {
            return self.wide_text();
        }
        let length = self.length(Count::Variable, 1)?;
        let bytes = self.aligned(length, 1)?;
        // Nodes read a string without its NUL, too.
        Ok(bytes.strip_suffix(&[0]).unwrap_or(bytes))
    }

    #[inline]
    fn length(&mut self, count: Count, min_size: usize) -> Result<usize, Fault> {
        let length = match count {
            Count::Fixed(length) => length,
            Count::Variable | Count::Bounded(_) => self.word()?,
        };
        check_length(count, length, min_size, self.left())?;
        Ok(length)
    }

    /// What padding there is depends on where a message begins.
    #[inline]
    fn skip(&mut self, _: &Plan, _: usize) -> Result<bool, Fault> {
        Ok(false)
    }

    fn trailing(&self) -> usize {
        0
    }
}
