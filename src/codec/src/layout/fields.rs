//! Fields one after the other, in either of two formats.
//!
//! ROS 1: packed. CDR (XCDR1 of DDS-XTypes 1.3, 7.4.3; little endian): four bytes that name the encoding, then every number at a multiple
//! of its size, counted from there; a string counts its final zero; up to three bytes at the end fill the last word (RTPS 2.5, 10.2).
//!
//! ```text
//!   std_msgs/Header   ROS 1: seq    | secs | nsecs   | length | frame_id
//!                     CDR:   00 01… | sec  | nanosec | length | frame_id 00 | 0 to 3 bytes
//! ```

use crate::wire::Cursor;

/// The identifier of CDR, little endian; two bytes of options follow it.
const CDR_LITTLE_ENDIAN: [u8; 2] = [0x00, 0x01];
/// From where CDR counts.
const ORIGIN: usize = 4;
/// At most so many bytes fill the last word.
const LONGEST_TAIL: usize = 3;

#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Format {
    Ros1,
    Cdr,
}

/// Reads the front of a message, field by field; `None` where it ends too early or is malformed.
#[derive(Clone, Copy)]
pub(super) struct Fields<'a> {
    input: Cursor<'a>,
    length: usize,
    format: Format,
}

/// What `read` finds, in the first of the formats in which it finds something.
pub(super) fn in_either<T>(head: &[u8], read: impl Fn(Fields<'_>) -> Option<T>) -> Option<T> {
    let fields = |format| Fields {
        input: Cursor::new(head),
        length: head.len(),
        format,
    };
    let is_cdr = head.starts_with(&CDR_LITTLE_ENDIAN);
    read(fields(Format::Ros1)).or_else(|| is_cdr.then(|| read(fields(Format::Cdr)))?)
}

impl<'a> Fields<'a> {
    /// Skips `std_msgs/Header`.
    pub(super) fn header(&mut self) -> Option<()> {
        // What names CDR takes the room of `seq`.
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
    pub(super) fn words(&mut self, count: usize) -> Option<()> {
        self.align(4)?;
        self.take(count * 4)
    }

    /// Skips numbers of 8 bytes.
    pub(super) fn doubles(&mut self, count: usize) -> Option<()> {
        self.align(8)?;
        self.take(count * 8)
    }

    pub(super) fn string(&mut self) -> Option<&'a [u8]> {
        let length = self.size()?;
        let bytes = self.input.take(length).ok()?;
        match self.format {
            Format::Ros1 => Some(bytes),
            Format::Cdr => bytes.strip_suffix(&[0]),
        }
    }

    /// Bytes read up to here.
    pub(super) fn taken(&self) -> usize {
        self.length - self.input.remaining()
    }

    /// How many bytes follow `data` more in a message of `total` bytes; `None` unless that is what the format adds.
    pub(super) fn tail(&self, data: usize, total: usize) -> Option<usize> {
        let tail = total.checked_sub(self.taken())?.checked_sub(data)?;
        let longest = match self.format {
            Format::Ros1 => 0,
            Format::Cdr => LONGEST_TAIL,
        };
        (tail <= longest).then_some(tail)
    }

    fn align(&mut self, size: usize) -> Option<()> {
        if self.format == Format::Ros1 {
            return Some(());
        }
        let from_origin = self.taken().checked_sub(ORIGIN)?;
        self.take(from_origin.next_multiple_of(size) - from_origin)
    }

    fn take(&mut self, count: usize) -> Option<()> {
        self.input.take(count).ok()?;
        Some(())
    }
}
