//! Little helpers for the bytes of a frame: varints out, a checked cursor in.

use crate::Error;

/// Appends `value` in base 128, low bits first.
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

/// Maps a signed difference to an unsigned one whose size grows with the difference's.
pub(crate) fn zigzag(value: i64) -> u64 {
    ((value << 1) ^ (value >> 63)) as u64
}

/// The inverse of [`zigzag`].
pub(crate) fn unzigzag(value: u64) -> i64 {
    (value >> 1) as i64 ^ -((value & 1) as i64)
}

/// What stands around a message's big array.
#[derive(Clone, Copy)]
pub(crate) struct Ends<'a> {
    head: &'a [u8],
    tail: &'a [u8],
}

impl<'a> Ends<'a> {
    /// Of both, one after the other; the tail begins at `head`.
    pub(crate) fn of(both: &'a [u8], head: usize) -> Self {
        let (head, tail) = both.split_at(head);
        Self { head, tail }
    }

    /// The first `head` bytes of `message`, and the last `tail`.
    pub(crate) fn around(message: &'a [u8], head: usize, tail: usize) -> Self {
        Self {
            head: &message[..head],
            tail: &message[message.len() - tail..],
        }
    }

    /// Appends both, preceded by their length.
    pub(crate) fn put(&self, out: &mut Vec<u8>) {
        put_varint(out, (self.head.len() + self.tail.len()) as u64);
        out.extend_from_slice(self.head);
        out.extend_from_slice(self.tail);
    }

    /// Appends a message whose array is `data` zeros, which are to be replaced.
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
pub(crate) struct Cursor<'a> {
    rest: &'a [u8],
}

impl<'a> Cursor<'a> {
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

    /// Everything that is left.
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

    /// A varint that must not exceed `limit`: the guard before every allocation.
    pub(crate) fn bounded(&mut self, limit: usize) -> Result<usize, Error> {
        let value = self.varint()?;
        usize::try_from(value)
            .ok()
            .filter(|&value| value <= limit)
            .ok_or(Error::Corrupt("a count larger than what it counts"))
    }

    /// The counterpart of [`put_block`].
    pub(crate) fn block(&mut self) -> Result<&'a [u8], Error> {
        let length = self.bounded(self.rest.len())?;
        self.take(length)
    }

    /// Fails when bytes are left over: a frame is read to its end or not at all.
    pub(crate) fn finish(self) -> Result<(), Error> {
        if self.rest.is_empty() {
            Ok(())
        } else {
            Err(Error::Corrupt("bytes after the end"))
        }
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
        let mut cursor = Cursor::new(&bytes);
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
        assert!(matches!(
            Cursor::new(&bytes).block(),
            Err(Error::Corrupt(_))
        ));
        assert!(matches!(
            Cursor::new(&[0x80; 12]).varint(),
            Err(Error::Corrupt(_))
        ));
        assert!(matches!(
            Cursor::new(&[0x80]).varint(),
            Err(Error::Truncated)
        ));
    }
}
