//! A ROS 2 message that is the last field of another message: extracted to stand alone, or appended behind the other
//! fields. The payloads of actions are embedded in this way behind a goal id or a status.
//!
//! The byte order is kept. Where all values keep their offset modulo their alignment, they are copied as one block;
//! otherwise they are padded anew, one by one, and every length is checked, because the data comes from untrusted
//! peers.

use std::collections::HashSet;

use bytes::Bytes;

use crate::RosVersion;
use crate::codec::cdr::{HEADER, WIDE, split_header};
use crate::codec::cursor::MessageCursor;
use crate::schema::MessageType;
use crate::schema::plan::{Count, Kind, Scalar};

/// Size of the largest number.
const LARGEST: usize = 8;

/// Returns a message that consists of the bytes `before` and the message of type `of` that begins at byte `at` of the
/// body of `bytes` and ends it. `None` if there is no such message, which is fully checked only if the values have to
/// be padded anew.
pub fn extract_embedded(of: &MessageType, bytes: &[u8], at: usize, before: &[u8]) -> Option<Bytes> {
    let (body, big_endian) = split_header(bytes).ok()?;
    let mut out = Vec::with_capacity(bytes.len() + before.len() + LARGEST);
    out.extend_from_slice(&HEADER);
    out[1] = u8::from(!big_endian);
    out.extend_from_slice(before);
    let first = first_alignment(of);
    let (from, to) = (at.next_multiple_of(first), before.len().next_multiple_of(first));
    let shift = from.abs_diff(to);
    if shift % LARGEST == 0 || shift % largest_alignment(of, &mut HashSet::new()) == 0 {
        let values = body.get(from..)?;
        if values.len() < of.min_size() {
            return None;
        }
        out.resize(HEADER.len() + to, 0);
        out.extend_from_slice(values);
        return Some(out.into());
    }
    let mut from = MessageCursor::new(RosVersion::Two, bytes)?;
    from.take(at, 1)?;
    let mut moving = ValueCopier { from, out };
    moving.message(of)?;
    Some(moving.out.into())
}

/// Returns the alignment of the first value.
fn first_alignment(of: &MessageType) -> usize {
    let Some(first) = of.plan.members.list().first() else {
        return 1;
    };
    match &first.kind {
        Kind::Scalar(scalar) | Kind::Scalars(scalar, Count::Fixed(_)) => scalar.alignment(),
        Kind::Bytes(Count::Fixed(_)) => 1,
        Kind::Struct(inner) | Kind::Structs(inner, Count::Fixed(_)) => first_alignment(inner),
        // The length of a string or sequence.
        _ => Scalar::U32.alignment(),
    }
}

/// Returns the largest alignment of any value. `seen`: types that were examined already.
fn largest_alignment<'a>(of: &'a MessageType, seen: &mut HashSet<&'a str>) -> usize {
    let mut largest = 1;
    for member in of.plan.members.list() {
        let alignment = match &member.kind {
            Kind::Scalar(scalar) | Kind::Scalars(scalar, Count::Fixed(_)) => scalar.alignment(),
            Kind::Bytes(Count::Fixed(_)) => 1,
            Kind::Scalars(scalar, _) => scalar.alignment().max(Scalar::U32.alignment()),
            Kind::Text(_) | Kind::Texts(..) | Kind::Bytes(_) => Scalar::U32.alignment(),
            Kind::Struct(inner) | Kind::Structs(inner, _) => {
                let length = match member.kind {
                    Kind::Structs(_, Count::Variable | Count::Bounded(_)) => Scalar::U32.alignment(),
                    _ => 1,
                };
                if seen.insert(inner.name()) { largest_alignment(inner, seen).max(length) } else { length }
            }
        };
        largest = largest.max(alignment);
        if largest == LARGEST {
            break;
        }
    }
    largest
}

/// Copies values from one body to another.
struct ValueCopier<'a> {
    from: MessageCursor<'a>,
    out: Vec<u8>,
}

impl<'a> ValueCopier<'a> {
    fn message(&mut self, of: &MessageType) -> Option<()> {
        for member in of.plan.members.list() {
            self.value(&member.kind)?;
        }
        if of.plan.placeholder {
            self.copy(1, 1)?;
        }
        Some(())
    }

    fn value(&mut self, kind: &Kind) -> Option<()> {
        match kind {
            Kind::Scalar(scalar) => self.copy(scalar.size(), scalar.alignment()).map(drop),
            Kind::Text(text) => {
                let unit = if text.wide { WIDE } else { 1 };
                let length = self.length(Count::Variable)?;
                self.copy(length.checked_mul(unit)?, 1).map(drop)
            }
            Kind::Bytes(count) => {
                let length = self.length(*count)?;
                self.copy(length, 1).map(drop)
            }
            Kind::Scalars(scalar, count) => match self.length(*count)? {
                0 => Some(()),
                length => {
                    let size = length.checked_mul(scalar.size())?;
                    self.copy(size, scalar.alignment()).map(drop)
                }
            },
            Kind::Texts(text, count) => (0..self.length(*count)?).try_for_each(|_| self.value(&Kind::Text(*text))),
            Kind::Struct(inner) => self.message(inner),
            Kind::Structs(inner, count) => (0..self.length(*count)?).try_for_each(|_| self.message(inner)),
        }
    }

    fn copy(&mut self, size: usize, alignment: usize) -> Option<&'a [u8]> {
        let bytes = self.from.take(size, alignment)?;
        let length = self.out.len() - HEADER.len();
        let padding = length.next_multiple_of(alignment) - length;
        self.out.extend_from_slice(&[0; LARGEST][..padding]);
        self.out.extend_from_slice(bytes);
        Some(bytes)
    }

    /// Reads a length; it cannot exceed the number of remaining bytes, because each element has at least one.
    fn length(&mut self, count: Count) -> Option<usize> {
        if let Count::Fixed(length) = count {
            return Some(length);
        }
        let word: [u8; 4] = self.copy(4, 4)?.try_into().ok()?;
        let length =
            if self.from.is_big_endian() { u32::from_be_bytes(word) } else { u32::from_le_bytes(word) } as usize;
        (length <= self.from.remaining()).then_some(length)
    }
}
