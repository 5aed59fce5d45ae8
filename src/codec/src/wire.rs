//! Helpers for the bytes of a frame: varints out, a checked cursor in.

use crate::Error;

/// Appends `value` as a varint in base 128, low bits first.
pub(crate) fn put_varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

/// Appends `bytes` preceded by their length.
pub(crate) fn put_block(out: &mut Vec<u8>, bytes: &[u8]) {
    put_varint(out, bytes.len() as u64);
    out.extend_from_slice(bytes);
}

/// Maps a signed difference to an unsigned one that grows with its magnitude.
pub(crate) fn zigzag(value: i64) -> u64 {
    ((value << 1) ^ (value >> 63)) as u64
}

/// The inverse of [`zigzag`].
pub(crate) fn unzigzag(value: u64) -> i64 {
    (value >> 1) as i64 ^ -((value & 1) as i64)
}

/// The bytes around a message's big array.
#[derive(Clone, Copy)]
pub(crate) struct MessageEnds<'a> {
    head: &'a [u8],
    tail: &'a [u8],
}

impl<'a> MessageEnds<'a> {
    /// Creates the ends from a joined block; the tail begins at `head`.
    pub(crate) fn from_joined(both: &'a [u8], head: usize) -> Self {
        let (head, tail) = both.split_at(head);
        Self { head, tail }
    }

    /// Takes the first `head` bytes of `message`, and the last `tail`.
    pub(crate) fn from_message(message: &'a [u8], head: usize, tail: usize) -> Self {
        Self { head: &message[..head], tail: &message[message.len() - tail..] }
    }

    /// Appends both, preceded by their length.
    pub(crate) fn put(&self, out: &mut Vec<u8>) {
        put_varint(out, (self.head.len() + self.tail.len()) as u64);
        out.extend_from_slice(self.head);
        out.extend_from_slice(self.tail);
    }

    /// Appends a message whose array is `data` zeros, and returns that array to be overwritten.
    pub(crate) fn restore<'o>(&self, data: usize, out: &'o mut Vec<u8>) -> &'o mut [u8] {
        let first = out.len() + self.head.len();
        out.extend_from_slice(self.head);
        out.resize(first + data, 0);
        out.extend_from_slice(self.tail);
        &mut out[first..first + data]
    }

    /// Appends a message whose array `write` appends.
    pub(crate) fn restore_with(
        &self,
        out: &mut Vec<u8>,
        write: impl FnOnce(&mut Vec<u8>) -> Result<(), Error>,
    ) -> Result<(), Error> {
        out.extend_from_slice(self.head);
        write(out)?;
        out.extend_from_slice(self.tail);
        Ok(())
    }
}

/// Reads a frame from the front; every step is checked, none allocates.
#[derive(Clone, Copy)]
pub(crate) struct FrameCursor<'a> {
    rest: &'a [u8],
}

impl<'a> FrameCursor<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes }
    }

    pub(crate) fn remaining(&self) -> usize {
        self.rest.len()
    }

    pub(crate) fn take(&mut self, count: usize) -> Result<&'a [u8], Error> {
        if count > self.rest.len() {
            return Err(Error::Truncated);
        }
        let (front, back) = self.rest.split_at(count);
        self.rest = back;
        Ok(front)
    }

    /// Returns all remaining bytes.
    pub(crate) fn take_rest(&mut self) -> &'a [u8] {
        std::mem::take(&mut self.rest)
    }

    pub(crate) fn byte(&mut self) -> Result<u8, Error> {
        Ok(self.take(1)?[0])
    }

    pub(crate) fn u32(&mut self) -> Result<u32, Error> {
        let bytes = self.take(4)?;
        Ok(u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]))
    }

    pub(crate) fn varint(&mut self) -> Result<u64, Error> {
        let mut value = 0u64;
        for shift in (0..64).step_by(7) {
            let byte = self.byte()?;
            value |= u64::from(byte & 0x7f) << shift;
            if byte < 0x80 {
                return Ok(value);
            }
        }
        Err(Error::Corrupt("a number of more than ten bytes"))
    }

    /// Reads a varint that must not exceed `limit`: the check before every allocation.
    pub(crate) fn bounded_varint(&mut self, limit: usize) -> Result<usize, Error> {
        let value = self.varint()?;
        usize::try_from(value)
            .ok()
            .filter(|&value| value <= limit)
            .ok_or(Error::Corrupt("a count larger than what it counts"))
    }

    /// Reads what [`put_block`] wrote.
    pub(crate) fn block(&mut self) -> Result<&'a [u8], Error> {
        let length = self.bounded_varint(self.rest.len())?;
        self.take(length)
    }

    /// Fails if bytes are left over: a frame is read to its end or not at all.
    pub(crate) fn finish(self) -> Result<(), Error> {
        if self.rest.is_empty() { Ok(()) } else { Err(Error::Corrupt("bytes after the end")) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_come_back_as_they_went_in() {
        let mut bytes = Vec::new();
        let numbers = [0, 1, 127, 128, 300, u64::from(u32::MAX), u64::MAX];
        for number in numbers {
            put_varint(&mut bytes, number);
        }
        let mut cursor = FrameCursor::new(&bytes);
        for number in numbers {
            assert_eq!(cursor.varint().unwrap(), number);
        }
        cursor.finish().unwrap();
        for value in [0, -1, 1, i64::MIN, i64::MAX] {
            assert_eq!(unzigzag(zigzag(value)), value);
        }
    }

    #[test]
    fn a_block_cannot_claim_more_than_there_is() {
        let mut bytes = Vec::new();
        put_varint(&mut bytes, 10);
        bytes.extend_from_slice(b"short");
        assert!(matches!(FrameCursor::new(&bytes).block(), Err(Error::Corrupt(_))));
        assert!(matches!(FrameCursor::new(&[0x80; 12]).varint(), Err(Error::Corrupt(_))));
        assert!(matches!(FrameCursor::new(&[0x80]).varint(), Err(Error::Truncated)));
    }
}
