//! Reader for messages about parameters from untrusted peers. The values read take many times the size of the message,
//! so both are bounded.

use ros_bus::RosVersion;
use ros_message::codec::cursor::MessageCursor;

/// Maximum size of a message.
const MAX_BYTES: usize = 16 << 20;
/// Maximum number of list elements in a message.
const MAX_ELEMENTS: usize = 1 << 20;

/// Reader of a message. Methods return `None` where the message ends too early.
pub struct ParameterReader<'a> {
    cursor: MessageCursor<'a>,
    /// Remaining number of elements.
    elements: usize,
}

impl<'a> ParameterReader<'a> {
    /// Creates a reader at the beginning of the message; `None` if it is too long.
    pub fn new(bytes: &'a [u8]) -> Option<Self> {
        let cursor = MessageCursor::new(RosVersion::Two, bytes)?;
        (bytes.len() <= MAX_BYTES).then_some(Self { cursor, elements: MAX_ELEMENTS })
    }

    /// Reads a byte.
    pub fn byte(&mut self) -> Option<u8> {
        self.cursor.number().map(|[byte]| byte)
    }

    /// Reads a bool.
    pub fn bool(&mut self) -> Option<bool> {
        self.byte().map(|byte| byte != 0)
    }

    /// Reads an `int64`.
    pub fn integer(&mut self) -> Option<i64> {
        self.cursor.number().map(i64::from_le_bytes)
    }

    /// Reads a `uint64`.
    pub fn unsigned_integer(&mut self) -> Option<u64> {
        self.cursor.number().map(u64::from_le_bytes)
    }

    /// Reads a `float64`.
    pub fn double(&mut self) -> Option<f64> {
        self.cursor.number().map(f64::from_le_bytes)
    }

    /// Skips a time.
    pub fn skip_time(&mut self) -> Option<()> {
        self.cursor.skip(2, 4, 4)
    }

    /// Reads a text; invalid UTF-8 is replaced.
    pub fn text(&mut self) -> Option<String> {
        let bytes = self.text_bytes()?;
        Some(String::from_utf8_lossy(bytes).into_owned())
    }

    /// Reads the bytes of a text.
    pub fn text_bytes(&mut self) -> Option<&'a [u8]> {
        let bytes = self.cursor.string(false)?;
        Some(bytes.strip_suffix(&[0]).unwrap_or(bytes))
    }

    /// Reads a list of bytes or bools.
    pub fn bytes(&mut self) -> Option<&'a [u8]> {
        let length = self.cursor.length()?;
        self.cursor.take(length, 1)
    }

    /// Reads a list of 8-byte numbers, as little-endian bytes.
    pub fn numbers(&mut self) -> Option<impl ExactSizeIterator<Item = [u8; 8]> + use<'a>> {
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

    /// Reads a list of texts.
    pub fn texts(&mut self) -> Option<Vec<String>> {
        self.list(Self::text)
    }

    /// Skips a list of texts.
    pub fn skip_texts(&mut self) -> Option<()> {
        let length = self.cursor.length()?;
        (0..length).try_for_each(|_| self.text_bytes().map(drop))
    }

    /// Reads a list, element by element.
    pub fn list<T>(&mut self, one: impl Fn(&mut Self) -> Option<T>) -> Option<Vec<T>> {
        let length = self.cursor.length()?;
        self.spend(length)?;
        (0..length).map(|_| one(self)).collect()
    }

    /// Counts elements that are kept; `None` beyond the limit.
    pub fn spend(&mut self, elements: usize) -> Option<()> {
        self.elements = self.elements.checked_sub(elements)?;
        Some(())
    }
}
