//! A message of ROS 2 that is the last field of another: taken out to stand alone, or put behind the other fields. What an
//! action carries stands so behind a goal's id or a status.
//!
//! The order of bytes stays what it is. Where all values are as far from multiples of their sizes as before, they are
//! copied in one piece; else they are padded anew, one by one, and every length is checked, for strangers have sent it.

use std::collections::HashSet;

use bytes::Bytes;

use crate::bus::RosVersion;
use crate::codec::cdr::{HEADER, WIDE, split_header};
use crate::codec::cursor::Cursor;
use crate::schema::MessageType;
use crate::schema::plan::{Count, Kind, Scalar};

/// No number is larger.
const LARGEST: usize = 8;

/// Behind the bytes `before`, in a body of its own: the message of type `of` that begins at byte `at` of the body of
/// `bytes` and is the last in it. None where no such message is there; that there is one is only known of values that had
/// to be padded anew.
pub(crate) fn embedded(of: &MessageType, bytes: &[u8], at: usize, before: &[u8]) -> Option<Bytes> {
    let (body, big_endian) = split_header(bytes).ok()?;
    let mut out = Vec::with_capacity(bytes.len() + before.len() + LARGEST);
    out.extend_from_slice(&HEADER);
    out[1] = u8::from(!big_endian);
    out.extend_from_slice(before);
    let first = first_alignment(of);
    let (from, to) = (
        at.next_multiple_of(first),
        before.len().next_multiple_of(first),
    );
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
    let mut from = Cursor::new(RosVersion::Two, bytes)?;
    from.take(at, 1)?;
    let mut moving = Moving { from, out };
    moving.message(of)?;
    Some(moving.out.into())
}

/// Of its first value.
fn first_alignment(of: &MessageType) -> usize {
    let Some(first) = of.plan.members.list().first() else {
        return 1;
    };
    match &first.kind {
        Kind::Scalar(scalar) | Kind::Scalars(scalar, Count::Fixed(_)) => scalar.alignment(),
        Kind::Bytes(Count::Fixed(_)) => 1,
        Kind::Struct(inner) | Kind::Structs(inner, Count::Fixed(_)) => first_alignment(inner),
        // The length of a text or a list.
        _ => Scalar::U32.alignment(),
    }
}

/// Of the value that has the largest. `seen`: types that need no second look.
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
                    Kind::Structs(_, Count::Variable | Count::Bounded(_)) => {
                        Scalar::U32.alignment()
                    }
                    _ => 1,
                };
                match seen.insert(inner.name()) {
                    true => largest_alignment(inner, seen).max(length),
                    false => length,
                }
            }
        };
        largest = largest.max(alignment);
        if largest == LARGEST {
            break;
        }
    }
    largest
}

/// Values on their way from one body to another.
struct Moving<'a> {
    from: Cursor<'a>,
    out: Vec<u8>,
}

impl<'a> Moving<'a> {
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
            Kind::Texts(text, count) => {
                (0..self.length(*count)?).try_for_each(|_| self.value(&Kind::Text(*text)))
            }
            Kind::Struct(inner) => self.message(inner),
            Kind::Structs(inner, count) => {
                (0..self.length(*count)?).try_for_each(|_| self.message(inner))
            }
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

    /// At most as many as there are bytes: each element has some.
    fn length(&mut self, count: Count) -> Option<usize> {
        if let Count::Fixed(length) = count {
            return Some(length);
        }
        let word: [u8; 4] = self.copy(4, 4)?.try_into().ok()?;
        let length = match self.from.is_big_endian() {
            true => u32::from_be_bytes(word),
            false => u32::from_le_bytes(word),
        } as usize;
        (length <= self.from.left()).then_some(length)
    }
}
