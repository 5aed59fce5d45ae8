//! The message being written.

use ros_message::RosVersion;
use ros_message::codec::{CodecErrorKind, DEFAULT_MAX_BYTES, Fault};

/// Header of ROS 2's serialization: plain CDR, little endian (OMG DDS-XTypes 1.3, section 7.6.3.1.2).
const HEADER: [u8; 4] = [0, 1, 0, 0];

/// Bytes that are written for each byte read, at most: UTF-16 takes four times the bytes of its UTF-8, padding less
/// than twice, and a few fields that only the twin has come in each element of an array.
const MOST_TIMES: usize = 16;

/// A message in the serialization of one ROS version, up to a limit.
#[derive(Debug)]
pub(crate) struct Output {
    bytes: Vec<u8>,
    aligned: bool,
    limit: usize,
}

impl Output {
    /// Begins a message that is made of `given` bytes and takes `least` bytes when it is empty.
    pub(crate) fn new(version: RosVersion, given: usize, least: usize) -> Output {
        let aligned = version == RosVersion::Two;
        let limit = given.saturating_mul(MOST_TIMES).saturating_add(least).min(DEFAULT_MAX_BYTES);
        let mut bytes = Vec::with_capacity(given + 64);
        if aligned {
            bytes.extend_from_slice(&HEADER);
        }
        Output { bytes, aligned, limit }
    }

    /// Checks that `more` bytes, and padding before them, may be written.
    #[inline]
    pub(crate) fn check_room(&self, more: usize) -> Result<(), Fault> {
        if self.bytes.len().saturating_add(more) <= self.limit {
            return Ok(());
        }
        Err(CodecErrorKind::TooLarge(self.limit).into())
    }

    #[inline]
    fn align(&mut self, width: usize) {
        if self.aligned {
            let length = self.bytes.len() - HEADER.len();
            let padding = length.wrapping_neg() & (width - 1);
            self.bytes.extend_from_slice(&[0; 8][..padding]);
        }
    }

    /// Writes numbers of `width` bytes, given in the byte order of the input.
    #[inline]
    pub(crate) fn put(&mut self, width: usize, numbers: &[u8], big_endian: bool) -> Result<(), Fault> {
        self.check_room(numbers.len())?;
        self.align(width);
        let begin = self.bytes.len();
        self.bytes.extend_from_slice(numbers);
        if big_endian && width > 1 {
            for number in self.bytes[begin..].chunks_exact_mut(width) {
                number.reverse();
            }
        }
        Ok(())
    }

    /// Writes `count` zero bytes in numbers of `width`.
    pub(crate) fn put_zeros(&mut self, width: usize, count: usize) -> Result<(), Fault> {
        self.check_room(count)?;
        self.align(width);
        self.bytes.resize(self.bytes.len() + count, 0);
        Ok(())
    }

    /// Writes a length.
    #[inline]
    pub(crate) fn put_length(&mut self, length: usize) -> Result<(), Fault> {
        let length = u32::try_from(length).map_err(|_| CodecErrorKind::TooLarge(self.limit))?;
        self.put(4, &length.to_le_bytes(), false)
    }

    /// Writes a length that `write` returns, before what it writes; the bytes it may write are checked beforehand.
    pub(crate) fn put_counted(&mut self, write: impl FnOnce(&mut Vec<u8>) -> usize) -> Result<(), Fault> {
        self.put_length(0)?;
        let begin = self.bytes.len();
        let length = write(&mut self.bytes);
        let length = u32::try_from(length).map_err(|_| CodecErrorKind::TooLarge(self.limit))?;
        self.bytes[begin - 4..begin].copy_from_slice(&length.to_le_bytes());
        Ok(())
    }

    /// Returns the message.
    pub(crate) fn finish(self) -> Vec<u8> {
        self.bytes
    }
}
