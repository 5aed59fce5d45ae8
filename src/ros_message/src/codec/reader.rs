//! Readers of serialized values. Every length is checked against the remaining bytes before it is used.

use crate::codec::fault::{CodecErrorKind, Fault};
use crate::schema::plan::{CodecPlan, Count, Scalar, Text};

/// Maximum length of an array whose elements have no bytes: such elements cost nothing on the wire.
const MAX_EMPTY_ELEMENTS: usize = 1 << 16;

/// Reads the values of a message in order. Returned numbers are little endian and text is UTF-8, whatever the encoding
/// of the message.
pub(crate) trait SerializedReader {
    /// True if a type without fields is serialized as one byte.
    const PLACEHOLDERS: bool;
    /// Reads one scalar.
    fn scalar(&mut self, scalar: Scalar) -> Result<&[u8], Fault>;
    /// Reads `length` scalars, without gaps.
    fn scalars(&mut self, scalar: Scalar, length: usize) -> Result<&[u8], Fault>;
    /// Reads `size` bytes.
    fn take(&mut self, size: usize) -> Result<&[u8], Fault>;
    /// Reads a string; the result excludes the length.
    fn text(&mut self, text: Text) -> Result<&[u8], Fault>;
    /// Reads the number of elements of an array, each of at least `min_size` bytes; guarantees that at least that many
    /// bytes follow.
    fn length(&mut self, count: Count, min_size: usize) -> Result<usize, Fault>;
    /// Skips `length` messages of a fixed size if that is possible without examining them; otherwise returns false and
    /// does nothing.
    fn skip(&mut self, plan: &CodecPlan, length: usize) -> Result<bool, Fault>;
    /// Returns the number of surplus bytes after the message.
    fn trailing(&self) -> usize;
}

/// ROS 1: little endian, values without padding.
pub(crate) struct Packed<'a> {
    pub(crate) rest: &'a [u8],
}

impl SerializedReader for Packed<'_> {
    const PLACEHOLDERS: bool = false;

    #[inline]
    fn scalar(&mut self, scalar: Scalar) -> Result<&[u8], Fault> {
        self.take(scalar.size())
    }

    #[inline]
    fn scalars(&mut self, scalar: Scalar, length: usize) -> Result<&[u8], Fault> {
        self.take(length * scalar.size())
    }

    #[inline]
    fn take(&mut self, size: usize) -> Result<&[u8], Fault> {
        let Some((taken, rest)) = self.rest.split_at_checked(size) else {
            return Err(CodecErrorKind::Truncated { missing: size - self.rest.len() }.into());
        };
        self.rest = rest;
        Ok(taken)
    }

    #[inline]
    fn text(&mut self, _: Text) -> Result<&[u8], Fault> {
        let length = self.length(Count::Variable, 1)?;
        self.take(length)
    }

    #[inline]
    fn length(&mut self, count: Count, min_size: usize) -> Result<usize, Fault> {
        let length = match count {
            Count::Fixed(length) => length,
            Count::Variable | Count::Bounded(_) => {
                let mut length = [0; 4];
                length.copy_from_slice(self.take(4)?);
                u32::from_le_bytes(length) as usize
            }
        };
        check_length(count, length, min_size, self.rest.len())?;
        Ok(length)
    }

    #[inline]
    fn skip(&mut self, plan: &CodecPlan, length: usize) -> Result<bool, Fault> {
        if plan.fixed_size {
            self.take(length * plan.min_size)?;
        }
        Ok(plan.fixed_size)
    }

    fn trailing(&self) -> usize {
        self.rest.len()
    }
}

/// Checks that an array of this length can fit into the `left` remaining bytes.
#[inline]
pub(crate) fn check_length(count: Count, length: usize, min_size: usize, left: usize) -> Result<(), Fault> {
    let fits = match min_size {
        0 => matches!(count, Count::Fixed(_)) || length <= MAX_EMPTY_ELEMENTS,
        _ => length.checked_mul(min_size).is_some_and(|size| size <= left),
    };
    if fits {
        return Ok(());
    }
    Err(CodecErrorKind::LengthBeyondEnd { count: length as u64, left }.into())
}
