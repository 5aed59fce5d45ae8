//! A cursor over the serialized bytes of either ROS version, for code that needs a few values and skips the rest.

use crate::RosVersion;
use crate::codec::cdr::{HEADER, WIDE, split_header};

/// Moves forward over one message. Methods return `None` where the message ends too early. A copy keeps its place.
#[derive(Debug, Clone, Copy)]
pub struct MessageCursor<'a> {
    bytes: &'a [u8],
    at: usize,
    /// Offset from which numbers are aligned; `None` in ROS 1, which has no alignment.
    origin: Option<usize>,
    big_endian: bool,
}

impl<'a> MessageCursor<'a> {
    /// Creates a cursor at the first value; `None` if the representation is not supported.
    pub fn new(version: RosVersion, bytes: &'a [u8]) -> Option<Self> {
        let big_endian = match version {
            RosVersion::One => false,
            RosVersion::Two => split_header(bytes).ok()?.1,
        };
        let origin = (version == RosVersion::Two).then_some(HEADER.len());
        Some(Self { bytes, at: origin.unwrap_or(0), origin, big_endian })
    }

    /// Returns the offset of the next value or its padding.
    pub fn position(&self) -> usize {
        self.at
    }

    /// Returns the number of remaining bytes.
    pub fn remaining(&self) -> usize {
        self.bytes.len() - self.at
    }

    /// Returns true if numbers in the message are big endian.
    pub fn is_big_endian(&self) -> bool {
        self.big_endian
    }

    /// Takes `size` bytes, after padding to `alignment`.
    pub fn take(&mut self, size: usize, alignment: usize) -> Option<&'a [u8]> {
        let begin = match self.origin {
            None => self.at,
            Some(origin) => origin + (self.at - origin).next_multiple_of(alignment),
        };
        let end = begin.checked_add(size)?;
        let taken = self.bytes.get(begin..end)?;
        self.at = end;
        Some(taken)
    }

    /// Takes a number, as little-endian bytes.
    pub fn number<const N: usize>(&mut self) -> Option<[u8; N]> {
        let mut number: [u8; N] = self.take(N, N)?.try_into().ok()?;
        if self.big_endian {
            number.reverse();
        }
        Some(number)
    }

    /// Takes a length.
    pub fn length(&mut self) -> Option<usize> {
        usize::try_from(u32::from_le_bytes(self.number()?)).ok()
    }

    /// Skips `count` numbers of `size` bytes.
    pub fn skip(&mut self, count: usize, size: usize, alignment: usize) -> Option<()> {
        if count > 0 {
            self.take(count.checked_mul(size)?, alignment)?;
        }
        Some(())
    }

    /// Takes a string's bytes, in ROS 2 with the terminating NUL.
    pub fn string(&mut self, wide: bool) -> Option<&'a [u8]> {
        let length = self.length()?;
        let unit = if wide { WIDE } else { 1 };
        self.take(length.checked_mul(unit)?, 1)
    }
}
