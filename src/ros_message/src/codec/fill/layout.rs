//! Output layouts of ROS 1 and ROS 2: padding, string termination, and defaults of missing fields.

use std::ops::Range;

use crate::codec::Time;
use crate::codec::realign::Realign;
use crate::schema::MessageType;
use crate::schema::initial::{Initial, InitialItem};
use crate::schema::plan::{Count, Kind, Member, Scalar, Text};

/// The layout of values in the output.
pub(super) trait OutputLayout: Copy {
    /// True if a type without fields is serialized as one byte.
    const PLACEHOLDERS: bool;
    /// True if strings end with a NUL, which counts in their length.
    const TERMINATED: bool;
    /// Appends padding before a value of this alignment, a power of two up to 8.
    fn align(self, out: &mut Vec<u8>, alignment: usize);
    /// Appends the default of a missing field; `now` is given for the stamp of a header, or for a header.
    fn put_default(self, out: &mut Vec<u8>, member: &Member, now: Option<Time>);
    /// Returns the distance of a position in the output from a multiple of 8, counted from the origin of alignment.
    fn phase(self, at: usize) -> usize;
    /// Appends a field that was written elsewhere: a range of `written`, which begins at such a multiple.
    fn put_piece(self, out: &mut Vec<u8>, member: &Member, written: &[u8], piece: Range<usize>);
}

/// ROS 1: values without padding.
#[derive(Clone, Copy)]
pub(super) struct Packed;

impl OutputLayout for Packed {
    const PLACEHOLDERS: bool = false;
    const TERMINATED: bool = false;

    #[inline(always)]
    fn align(self, _: &mut Vec<u8>, _: usize) {}

    fn put_default(self, out: &mut Vec<u8>, member: &Member, now: Option<Time>) {
        let begin = out.len();
        out.resize(begin + member.min_size, 0);
        let at = match &member.kind {
            Kind::Scalar(Scalar::Time) => begin,
            // The stamp follows the sequence number.
            Kind::Struct(message) if message.plan.header => begin + 4,
            _ => return,
        };
        if let Some(now) = now {
            out[at..at + 8].copy_from_slice(&time_bytes(now));
        }
    }

    fn phase(self, _: usize) -> usize {
        0
    }

    fn put_piece(self, out: &mut Vec<u8>, _: &Member, written: &[u8], piece: Range<usize>) {
        out.extend_from_slice(&written[piece]);
    }
}

/// ROS 2: each number at a multiple of its size.
#[derive(Clone, Copy)]
pub(super) struct Aligned {
    /// Offset of the body in the output.
    pub(super) origin: usize,
}

impl OutputLayout for Aligned {
    const PLACEHOLDERS: bool = true;
    const TERMINATED: bool = true;

    #[inline]
    fn align(self, out: &mut Vec<u8>, alignment: usize) {
        let length = out.len() - self.origin;
        let padding = length.wrapping_neg() & (alignment - 1);
        out.extend_from_slice(&[0; 8][..padding]);
    }

    fn put_default(self, out: &mut Vec<u8>, member: &Member, now: Option<Time>) {
        self.put_initial(out, &member.kind, member.initial.as_ref(), now);
    }

    fn phase(self, at: usize) -> usize {
        (at - self.origin) % 8
    }

    fn put_piece(self, out: &mut Vec<u8>, member: &Member, written: &[u8], piece: Range<usize>) {
        if piece.start % 8 == self.phase(out.len()) {
            out.extend_from_slice(&written[piece]);
            return;
        }
        let mut realign = Realign { from: &written[..piece.end], at: piece.start, out, origin: self.origin };
        realign.value(&member.kind);
    }
}

impl Aligned {
    fn put_initial(self, out: &mut Vec<u8>, kind: &Kind, initial: Option<&Initial>, now: Option<Time>) {
        let items = initial.map_or(&[][..], |initial| &initial.0);
        match kind {
            Kind::Scalar(scalar) => {
                self.align(out, scalar.alignment());
                match now {
                    Some(now) if *scalar == Scalar::Time2 => {
                        out.extend_from_slice(&time_bytes(now));
                    }
                    _ => put_scalars(out, *scalar, 1, items),
                }
            }
            Kind::Text(text) => self.put_text(out, *text, items.first()),
            Kind::Bytes(count) => {
                let length = self.put_length(out, *count, items);
                put_scalars(out, Scalar::U8, length, items);
            }
            Kind::Scalars(scalar, count) => {
                let length = self.put_length(out, *count, items);
                if length > 0 {
                    self.align(out, scalar.alignment());
                    put_scalars(out, *scalar, length, items);
                }
            }
            Kind::Texts(text, count) => {
                for index in 0..self.put_length(out, *count, items) {
                    self.put_text(out, *text, items.get(index));
                }
            }
            Kind::Struct(message) => self.put_default_message(out, message, now),
            Kind::Structs(message, count) => {
                for _ in 0..self.put_length(out, *count, items) {
                    self.put_default_message(out, message, None);
                }
            }
        }
    }

    fn put_default_message(self, out: &mut Vec<u8>, message: &MessageType, now: Option<Time>) {
        let now = now.filter(|_| message.plan.header);
        for member in message.plan.members.list() {
            self.put_initial(out, &member.kind, member.initial.as_ref(), now);
        }
        if message.plan.placeholder {
            out.push(0);
        }
    }

    fn put_length(self, out: &mut Vec<u8>, count: Count, items: &[InitialItem]) -> usize {
        if let Count::Fixed(length) = count {
            return length;
        }
        self.align(out, 4);
        // The text of a definition is much shorter than 4 GiB.
        out.extend_from_slice(&(items.len() as u32).to_le_bytes());
        items.len()
    }

    fn put_text(self, out: &mut Vec<u8>, text: Text, item: Option<&InitialItem>) {
        let written = match item {
            Some(InitialItem::Text(written)) => &**written,
            _ => "",
        };
        self.align(out, 4);
        let begin = out.len();
        out.extend_from_slice(&[0; 4]);
        let length = if text.wide {
            put_wide(out, written)
        } else {
            out.extend_from_slice(written.as_bytes());
            out.push(0);
            written.len() + 1
        };
        out[begin..begin + 4].copy_from_slice(&(length as u32).to_le_bytes());
    }
}

/// Appends the items, then zeros up to `length`.
fn put_scalars(out: &mut Vec<u8>, scalar: Scalar, length: usize, items: &[InitialItem]) {
    let size = scalar.size();
    let end = out.len() + length * size;
    for item in items.iter().take(length) {
        if let InitialItem::Scalar(bytes) = item {
            out.extend_from_slice(&bytes[..size]);
        }
    }
    out.resize(end, 0);
}

/// Appends the units of wide text; returns their number.
pub(super) fn put_wide(out: &mut Vec<u8>, text: &str) -> usize {
    let mut units = 0;
    for unit in text.encode_utf16() {
        out.extend_from_slice(&u32::from(unit).to_le_bytes());
        units += 1;
    }
    units
}

fn time_bytes(time: Time) -> [u8; 8] {
    let mut bytes = [0; 8];
    bytes[..4].copy_from_slice(&time.secs.to_le_bytes());
    bytes[4..].copy_from_slice(&time.nsecs.to_le_bytes());
    bytes
}
