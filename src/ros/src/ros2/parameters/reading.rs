//! Messages of strangers about parameters, read value by value. What is made of them takes many times their bytes, so both
//! are bounded.

use crate::bus::RosVersion;
use crate::codec::cursor::Cursor;

/// A longer message is not read.
const MAX_BYTES: usize = 16 << 20;
/// Nor is one that holds more elements of lists.
const MAX_ELEMENTS: usize = 1 << 20;

/// A message of which something is still to be read. All functions give none where the message ends too early.
pub(super) struct Reading<'a> {
    cursor: Cursor<'a>,
    /// How many elements may follow.
    elements: usize,
}

impl<'a> Reading<'a> {
    /// From the beginning.
    pub(super) fn of(bytes: &'a [u8]) -> Option<Self> {
        let cursor = Cursor::new(RosVersion::Two, bytes)?;
        (bytes.len() <= MAX_BYTES).then_some(Self {
            cursor,
            elements: MAX_ELEMENTS,
        })
    }

    pub(super) fn byte(&mut self) -> Option<u8> {
        self.cursor.number().map(|[byte]| byte)
    }

    pub(super) fn bool(&mut self) -> Option<bool> {
        self.byte().map(|byte| byte != 0)
    }

    pub(super) fn integer(&mut self) -> Option<i64> {
        self.cursor.number().map(i64::from_le_bytes)
    }

    pub(super) fn unsigned(&mut self) -> Option<u64> {
        self.cursor.number().map(u64::from_le_bytes)
    }

    pub(super) fn double(&mut self) -> Option<f64> {
        self.cursor.number().map(f64::from_le_bytes)
    }

    /// A time, at which nobody looks.
    pub(super) fn skip_time(&mut self) -> Option<()> {
        self.cursor.skip(2, 4, 4)
    }

    /// A text; what is no UTF-8 is replaced.
    pub(super) fn text(&mut self) -> Option<String> {
        let bytes = self.bytes_of_text()?;
        Some(String::from_utf8_lossy(bytes).into_owned())
    }

    pub(super) fn bytes_of_text(&mut self) -> Option<&'a [u8]> {
        let bytes = self.cursor.string(false)?;
        Some(bytes.strip_suffix(&[0]).unwrap_or(bytes))
    }

    /// A list of bytes, or of bools.
    pub(super) fn bytes(&mut self) -> Option<&'a [u8]> {
        let length = self.cursor.length()?;
        self.cursor.take(length, 1)
    }

    /// A list of numbers of eight bytes, little endian.
    pub(super) fn numbers(&mut self) -> Option<impl ExactSizeIterator<Item = [u8; 8]> + use<'a>> {
        let length = self.cursor.length()?;
        let bytes = match length {
            0 => &[][..],
            _ => self.cursor.take(length.checked_mul(8)?, 8)?,
        };
        let big_endian = self.cursor.is_big_endian();
        Some(bytes.chunks_exact(8).map(move |chunk| {
            let mut number = [0; 8];
            number.copy_from_slice(chunk);
            if big_endian {
                number.reverse();
            }
            number
        }))
    }

    pub(super) fn texts(&mut self) -> Option<Vec<String>> {
        self.list(Self::text)
    }

    pub(super) fn skip_texts(&mut self) -> Option<()> {
        let length = self.cursor.length()?;
        (0..length).try_for_each(|_| self.bytes_of_text().map(drop))
    }

    /// A list, element by element.
    pub(super) fn list<T>(&mut self, one: impl Fn(&mut Self) -> Option<T>) -> Option<Vec<T>> {
        let length = self.cursor.length()?;
        self.spend(length)?;
        (0..length).map(|_| one(self)).collect()
    }

    /// So many elements are kept.
    pub(super) fn spend(&mut self, elements: usize) -> Option<()> {
        self.elements = self.elements.checked_sub(elements)?;
        Some(())
    }
}
