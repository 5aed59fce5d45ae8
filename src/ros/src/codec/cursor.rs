//! A place in serialized bytes of either ROS, for those who look for a few values and go past the rest.

use crate::bus::RosVersion;
use crate::codec::cdr::{HEADER, WIDE, split_header};

/// Goes forward over one message. None where it ends too early.
pub(crate) struct Cursor<'a> {
    bytes: &'a [u8],
    at: usize,
    /// From where on numbers are aligned; None in ROS 1, where they are not.
    origin: Option<usize>,
    big_endian: bool,
}

impl<'a> Cursor<'a> {
    /// At the first value; None where it is serialized in a way that is not read here.
    pub(crate) fn new(version: RosVersion, bytes: &'a [u8]) -> Option<Self> {
        let big_endian = match version {
            RosVersion::One => false,
            RosVersion::Two => split_header(bytes).ok()?.1,
        };
        let origin = (version == RosVersion::Two).then_some(HEADER.len());
        Some(Self {
            bytes,
            at: origin.unwrap_or(0),
            origin,
            big_endian,
        })
    }

    /// Where the next value, or what pads it, begins.
    pub(crate) fn at(&self) -> usize {
        self.at
    }

    /// Bytes from there on.
    pub(crate) fn left(&self) -> usize {
        self.bytes.len() - self.at
    }

    pub(crate) fn is_big_endian(&self) -> bool {
        self.big_endian
    }

    /// So many bytes of numbers of a size.
    pub(crate) fn take(&mut self, size: usize, alignment: usize) -> Option<&'a [u8]> {
        let begin = match self.origin {
            None => self.at,
            Some(origin) => origin + (self.at - origin).next_multiple_of(alignment),
        };
        let end = begin.checked_add(size)?;
        let taken = self.bytes.get(begin..end)?;
        self.at = end;
        Some(taken)
    }

    /// A number, little endian.
    pub(crate) fn number<const N: usize>(&mut self) -> Option<[u8; N]> {
        let mut number: [u8; N] = self.take(N, N)?.try_into().ok()?;
        if self.big_endian {
            number.reverse();
        }
        Some(number)
    }

    /// A length.
    pub(crate) fn length(&mut self) -> Option<usize> {
        usize::try_from(u32::from_le_bytes(self.number()?)).ok()
    }

    /// So many numbers of a size, seen by no one.
    pub(crate) fn skip(&mut self, count: usize, size: usize, alignment: usize) -> Option<()> {
        if count > 0 {
            self.take(count.checked_mul(size)?, alignment)?;
        }
        Some(())
    }

    /// A string's bytes; in ROS 2 with the NUL behind it.
    pub(crate) fn string(&mut self, wide: bool) -> Option<&'a [u8]> {
        let length = self.length()?;
        let unit = if wide { WIDE } else { 1 };
        self.take(length.checked_mul(unit)?, 1)
    }
}
