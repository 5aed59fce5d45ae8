//! Where values stand in serialized bytes. Every length is checked against what is left before anything is done with it.

use crate::codec::fault::{CodecErrorKind, Fault};
use crate::schema::plan::{Count, Plan, Scalar, Text};

/// Elements without any bytes cost nothing on the wire, so their number is bounded here.
const MAX_EMPTY_ELEMENTS: usize = 1 << 16;

/// Takes values out of a message, front to back. What is given is little endian, and text is UTF-8, whatever the
/// message has.
pub(crate) trait Reader {
    /// Types without fields have a byte all the same.
    const PLACEHOLDERS: bool;
    /// One scalar, in as many bytes as it has.
    fn scalar(&mut self, scalar: Scalar) -> Result<&[u8], Fault>;
    /// So many scalars, one behind the other.
    fn scalars(&mut self, scalar: Scalar, length: usize) -> Result<&[u8], Fault>;
    /// So many bytes.
    fn take(&mut self, size: usize) -> Result<&[u8], Fault>;
    /// A string with its length, given without.
    fn text(&mut self, text: Text) -> Result<&[u8], Fault>;
    /// The number of elements of an array, each of at least `min_size` bytes; that many bytes are there.
    fn length(&mut self, count: Count, min_size: usize) -> Result<usize, Fault>;
    /// Goes past so many messages of a fixed size, where that takes no looking at them; else false, and nothing is done.
    fn skip(&mut self, plan: &Plan, length: usize) -> Result<bool, Fault>;
    /// Bytes behind what was taken that should not be there.
    fn trailing(&self) -> usize;
}

/// ROS 1: little endian, one value behind the other.
pub(crate) struct Packed<'a> {
    pub(crate) rest: &'a [u8],
}

impl Reader for Packed<'_> {
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
            return Err(CodecErrorKind::Truncated {
                missing: size - self.rest.len(),
            }
            .into());
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
    fn skip(&mut self, plan: &Plan, length: usize) -> Result<bool, Fault> {
        if plan.fixed_size {
            self.take(length * plan.min_size)?;
        }
        Ok(plan.fixed_size)
    }

    fn trailing(&self) -> usize {
        self.rest.len()
    }
}

/// Whether an array of this length can be in the `left` bytes.
#[inline]
pub(crate) fn check_length(
    count: Count,
    length: usize,
    min_size: usize,
    left: usize,
) -> Result<(), Fault> {
    let fits = match min_size {
        0 => matches!(count, Count::Fixed(_)) || length <= MAX_EMPTY_ELEMENTS,
        _ => length
            .checked_mul(min_size)
            .is_some_and(|size| size <= left),
    };
    if fits {
        return Ok(());
    }
    Err(CodecErrorKind::LengthBeyondEnd {
        count: length as u64,
        left,
    }
    .into())
}
