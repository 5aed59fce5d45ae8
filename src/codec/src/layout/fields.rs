//! Reads fields in sequence, in either of two formats.
//!
//! ROS 1: packed. CDR (XCDR1 of DDS-XTypes 1.3, 7.4.3; little endian): a four-byte encapsulation header, then every
//! number aligned to its size, counted from the end of that header; a string's length includes its final zero; up to
//! three bytes at the end fill the last word (RTPS 2.5, 10.2).
//!
//! ```text
//!   std_msgs/Header   ROS 1: seq    | secs | nsecs   | length | frame_id
//!                     CDR:   00 01… | sec  | nanosec | length | frame_id 00 | 0 to 3 bytes
//! ```

use crate::wire::FrameCursor;

/// Encapsulation identifier of little-endian CDR; two bytes of options follow it.
const CDR_LITTLE_ENDIAN: [u8; 2] = [0x00, 0x01];
/// Offset from which CDR counts alignment.
const ORIGIN: usize = 4;
/// Maximum number of bytes that fill the last word.
const LONGEST_TAIL: usize = 3;

#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum SerializationFormat {
    Ros1,
    Cdr,
}

/// Reads the front of a message, field by field; `None` if it ends too early or is malformed.
#[derive(Clone, Copy)]
pub(super) struct FieldReader<'a> {
    input: FrameCursor<'a>,
    length: usize,
    format: SerializationFormat,
}

/// Returns the result of `read` in the first format in which it succeeds.
pub(super) fn read_in_either_format<T>(head: &[u8], read: impl Fn(FieldReader<'_>) -> Option<T>) -> Option<T> {
    let fields = |format| FieldReader { input: FrameCursor::new(head), length: head.len(), format };
    let is_cdr = head.starts_with(&CDR_LITTLE_ENDIAN);
    read(fields(SerializationFormat::Ros1)).or_else(|| is_cdr.then(|| read(fields(SerializationFormat::Cdr)))?)
}

impl<'a> FieldReader<'a> {
    /// Skips a `std_msgs/Header`.
    pub(super) fn skip_header(&mut self) -> Option<()> {
        // The encapsulation header takes the place of `seq`.
        self.take(12)?;
        self.string()?;
        Some(())
    }

    pub(super) fn byte(&mut self) -> Option<u8> {
        self.input.byte().ok()
    }

    pub(super) fn size(&mut self) -> Option<usize> {
        self.align(4)?;
        usize::try_from(self.input.u32().ok()?).ok()
    }

    /// Skips numbers of 4 bytes.
    pub(super) fn skip_words(&mut self, count: usize) -> Option<()> {
        self.align(4)?;
        self.take(count * 4)
    }

    /// Skips numbers of 8 bytes.
    pub(super) fn skip_doubles(&mut self, count: usize) -> Option<()> {
        self.align(8)?;
        self.take(count * 8)
    }

    pub(super) fn string(&mut self) -> Option<&'a [u8]> {
        let length = self.size()?;
        let bytes = self.input.take(length).ok()?;
        match self.format {
            SerializationFormat::Ros1 => Some(bytes),
            SerializationFormat::Cdr => bytes.strip_suffix(&[0]),
        }
    }

    /// Returns the number of bytes read so far.
    pub(super) fn bytes_read(&self) -> usize {
        self.length - self.input.remaining()
    }

    /// Returns the number of bytes that follow `data` more bytes in a message of `total` bytes; `None` unless the
    /// format allows that padding.
    pub(super) fn tail_length(&self, data: usize, total: usize) -> Option<usize> {
        let tail = total.checked_sub(self.bytes_read())?.checked_sub(data)?;
        let longest = match self.format {
            SerializationFormat::Ros1 => 0,
            SerializationFormat::Cdr => LONGEST_TAIL,
        };
        (tail <= longest).then_some(tail)
    }

    fn align(&mut self, size: usize) -> Option<()> {
        if self.format == SerializationFormat::Ros1 {
            return Some(());
        }
        let from_origin = self.bytes_read().checked_sub(ORIGIN)?;
        self.take(from_origin.next_multiple_of(size) - from_origin)
    }

    fn take(&mut self, count: usize) -> Option<()> {
        self.input.take(count).ok()?;
        Some(())
    }
}
