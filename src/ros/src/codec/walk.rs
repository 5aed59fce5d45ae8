//! Serialized bytes, value by value, in the order of the plan. Every length is checked against what is left before
//! anything is done with it.

use crate::codec::fault::{CodecErrorKind, Fault};
use crate::schema::MessageType;
use crate::schema::plan::{Count, Kind, Literal, Plan, Scalar};

/// Elements without any bytes cost nothing on the wire, so their number is bounded here.
const MAX_EMPTY_ELEMENTS: usize = 1 << 16;

/// What becomes of the values.
pub(crate) trait Format {
    /// Values of fixed size may be skipped unseen.
    const SKIPS: bool = false;
    /// Writes what stands between two values.
    fn literal(&mut self, plan: &Plan, literal: &Literal);
    /// One scalar; `bytes` has its size.
    fn scalar(&mut self, scalar: Scalar, bytes: &[u8]);
    /// A string, without its length.
    fn text(&mut self, bytes: &[u8]) -> Result<(), Fault>;
    /// A `uint8[]` or `char[]`.
    fn bytes(&mut self, bytes: &[u8]);
    /// An array of other scalars; `bytes` is a multiple of their size.
    fn scalars(&mut self, scalar: Scalar, bytes: &[u8]);
    /// An array whose elements follow one by one.
    fn begin_array(&mut self, count: usize);
    /// The element `index` follows.
    fn element(&mut self, index: usize);
    /// All elements were there.
    fn end_array(&mut self);
    /// Whether `more` bytes may still be written.
    fn room(&self, more: usize) -> Result<(), Fault>;
}

/// Walks over `bytes`, which must be one message exactly.
pub(crate) fn walk<F: Format>(
    message: &MessageType,
    bytes: &[u8],
    format: &mut F,
) -> Result<(), Fault> {
    let mut reader = Reader { rest: bytes };
    walk_message(message, &mut reader, format)?;
    format.room(0)?;
    match reader.rest.len() {
        0 => Ok(()),
        trailing => Err(CodecErrorKind::Trailing(trailing).into()),
    }
}

/// Walks without looking at values.
pub(crate) fn validate(message: &MessageType, bytes: &[u8]) -> Result<(), Fault> {
    walk(message, bytes, &mut Nothing)
}

fn walk_message<F: Format>(
    message: &MessageType,
    reader: &mut Reader<'_>,
    format: &mut F,
) -> Result<(), Fault> {
    let plan = &message.plan;
    if F::SKIPS && plan.fixed_size {
        return reader.take(plan.min_size).map(drop);
    }
    for step in &plan.steps {
        format.literal(plan, &step.before);
        walk_value(&step.kind, reader, format).map_err(|fault| fault.in_field(&plan.path(step)))?;
    }
    format.literal(plan, &plan.tail);
    Ok(())
}

#[inline]
fn walk_value<F: Format>(
    kind: &Kind,
    reader: &mut Reader<'_>,
    format: &mut F,
) -> Result<(), Fault> {
    match kind {
        Kind::Scalar(scalar) => format.scalar(*scalar, reader.take(scalar.size())?),
        Kind::Text => {
            let length = reader.count(Count::Variable, 1)?;
            let text = reader.take(length)?;
            format.room(text.len())?;
            format.text(text)?;
        }
        Kind::Bytes(count) => {
            let length = reader.count(*count, 1)?;
            let bytes = reader.take(length)?;
            format.room(bytes.len())?;
            format.bytes(bytes);
        }
        Kind::Scalars(scalar, count) => {
            let length = reader.count(*count, scalar.size())?;
            let bytes = reader.take(length * scalar.size())?;
            format.room(length)?;
            format.scalars(*scalar, bytes);
        }
        Kind::Texts(count) => {
            let length = reader.count(*count, 4)?;
            walk_elements(length, format, |format| {
                walk_value(&Kind::Text, reader, format)
            })?;
        }
        Kind::Struct(message) => walk_message(message, reader, format)?,
        Kind::Structs(message, count) => {
            let length = reader.count(*count, message.plan.min_size)?;
            if F::SKIPS && message.plan.fixed_size {
                reader.take(length * message.plan.min_size)?;
                return Ok(());
            }
            walk_elements(length, format, |format| {
                walk_message(message, reader, format)
            })?;
        }
    }
    Ok(())
}

fn walk_elements<F: Format>(
    length: usize,
    format: &mut F,
    mut element: impl FnMut(&mut F) -> Result<(), Fault>,
) -> Result<(), Fault> {
    format.begin_array(length);
    for index in 0..length {
        format.element(index);
        element(format)
            .and_then(|()| format.room(0))
            .map_err(|fault| fault.at_index(index))?;
    }
    format.end_array();
    Ok(())
}

struct Reader<'a> {
    rest: &'a [u8],
}

impl<'a> Reader<'a> {
    #[inline]
    fn take(&mut self, size: usize) -> Result<&'a [u8], Fault> {
        let Some((taken, rest)) = self.rest.split_at_checked(size) else {
            return Err(CodecErrorKind::Truncated {
                missing: size - self.rest.len(),
            }
            .into());
        };
        self.rest = rest;
        Ok(taken)
    }

    /// The number of elements of an array, each of at least `min_size` bytes; that many bytes are there.
    #[inline]
    fn count(&mut self, count: Count, min_size: usize) -> Result<usize, Fault> {
        let length = match count {
            Count::Fixed(length) => length,
            Count::Variable => {
                let mut length = [0; 4];
                length.copy_from_slice(self.take(4)?);
                u32::from_le_bytes(length) as usize
            }
        };
        let fits = match min_size {
            0 => count != Count::Variable || length <= MAX_EMPTY_ELEMENTS,
            _ => length
                .checked_mul(min_size)
                .is_some_and(|size| size <= self.rest.len()),
        };
        if !fits {
            return Err(CodecErrorKind::LengthBeyondEnd {
                count: length as u64,
                left: self.rest.len(),
            }
            .into());
        }
        Ok(length)
    }
}

/// Writes nothing.
struct Nothing;

impl Format for Nothing {
    const SKIPS: bool = true;
    fn literal(&mut self, _: &Plan, _: &Literal) {}
    fn scalar(&mut self, _: Scalar, _: &[u8]) {}
    fn text(&mut self, _: &[u8]) -> Result<(), Fault> {
        Ok(())
    }
    fn bytes(&mut self, _: &[u8]) {}
    fn scalars(&mut self, _: Scalar, _: &[u8]) {}
    fn begin_array(&mut self, _: usize) {}
    fn element(&mut self, _: usize) {}
    fn end_array(&mut self) {}
    fn room(&self, _: usize) -> Result<(), Fault> {
        Ok(())
    }
}
