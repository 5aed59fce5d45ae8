//! Walks over serialized bytes value by value, in the order of the plan.

use crate::RosVersion;
use crate::codec::cdr::{Cdr, split_header};
use crate::codec::fault::{CodecErrorKind, Fault};
use crate::codec::reader::{Packed, SerializedReader};
use crate::schema::MessageType;
use crate::schema::plan::{CodecPlan, Kind, Literal, Scalar};

/// A consumer of the values of a message.
pub(crate) trait OutputFormat {
    /// True if values of fixed size may be skipped without being read.
    const SKIPS: bool = false;
    /// Writes the literal between two values.
    fn literal(&mut self, plan: &CodecPlan, literal: &Literal);
    /// Handles one scalar; `bytes` has its size.
    fn scalar(&mut self, scalar: Scalar, bytes: &[u8]);
    /// Handles a string, given without its length.
    fn text(&mut self, bytes: &[u8]) -> Result<(), Fault>;
    /// Handles a `uint8[]` or `char[]`.
    fn bytes(&mut self, bytes: &[u8]);
    /// Handles an array of other scalars; the length of `bytes` is a multiple of their size.
    fn scalars(&mut self, scalar: Scalar, bytes: &[u8]);
    /// Begins an array whose elements follow one by one.
    fn begin_array(&mut self, count: usize);
    /// Announces the element `index`.
    fn element(&mut self, index: usize);
    /// Ends the array after its last element.
    fn end_array(&mut self);
    /// Checks that `more` bytes may still be written.
    fn check_room(&self, more: usize) -> Result<(), Fault>;
}

/// Walks over `bytes`, which must be exactly one message.
pub(crate) fn walk<F: OutputFormat>(message: &MessageType, bytes: &[u8], format: &mut F) -> Result<(), Fault> {
    match message.version() {
        RosVersion::One => walk_all(message, Packed { rest: bytes }, format),
        RosVersion::Two => match split_header(bytes)? {
            (body, false) => walk_all(message, Cdr::<false>::new(body), format),
            (body, true) => walk_all(message, Cdr::<true>::new(body), format),
        },
    }
}

fn walk_all<R: SerializedReader, F: OutputFormat>(
    message: &MessageType,
    mut reader: R,
    format: &mut F,
) -> Result<(), Fault> {
    walk_message(message, &mut reader, format)?;
    format.check_room(0)?;
    match reader.trailing() {
        0 => Ok(()),
        trailing => Err(CodecErrorKind::Trailing(trailing).into()),
    }
}

/// Checks a message without using its values.
pub(crate) fn validate(message: &MessageType, bytes: &[u8]) -> Result<(), Fault> {
    walk(message, bytes, &mut Nothing)
}

fn walk_message<R: SerializedReader, F: OutputFormat>(
    message: &MessageType,
    reader: &mut R,
    format: &mut F,
) -> Result<(), Fault> {
    let plan = &message.plan;
    if F::SKIPS && reader.skip(plan, 1)? {
        return Ok(());
    }
    for step in &plan.steps {
        format.literal(plan, &step.before);
        walk_value(&step.kind, reader, format).map_err(|fault| fault.in_field(&plan.path(step)))?;
    }
    format.literal(plan, &plan.tail);
    if R::PLACEHOLDERS && plan.placeholder {
        reader.take(1)?;
    }
    Ok(())
}

#[inline]
fn walk_value<R: SerializedReader, F: OutputFormat>(kind: &Kind, reader: &mut R, format: &mut F) -> Result<(), Fault> {
    match kind {
        Kind::Scalar(scalar) => format.scalar(*scalar, reader.scalar(*scalar)?),
        Kind::Text(text) => {
            let text = reader.text(*text)?;
            format.check_room(text.len())?;
            format.text(text)?;
        }
        Kind::Bytes(count) => {
            let length = reader.length(*count, 1)?;
            let bytes = reader.take(length)?;
            format.check_room(bytes.len())?;
            format.bytes(bytes);
        }
        Kind::Scalars(scalar, count) => {
            let length = reader.length(*count, scalar.size())?;
            let bytes = reader.scalars(*scalar, length)?;
            format.check_room(length)?;
            format.scalars(*scalar, bytes);
        }
        Kind::Texts(text, count) => {
            let length = reader.length(*count, 4)?;
            walk_elements(length, format, |format| walk_value(&Kind::Text(*text), reader, format))?;
        }
        Kind::Struct(message) => walk_message(message, reader, format)?,
        Kind::Structs(message, count) => {
            let length = reader.length(*count, message.plan.min_size)?;
            if F::SKIPS && reader.skip(&message.plan, length)? {
                return Ok(());
            }
            walk_elements(length, format, |format| walk_message(message, reader, format))?;
        }
    }
    Ok(())
}

fn walk_elements<F: OutputFormat>(
    length: usize,
    format: &mut F,
    mut element: impl FnMut(&mut F) -> Result<(), Fault>,
) -> Result<(), Fault> {
    format.begin_array(length);
    for index in 0..length {
        format.element(index);
        element(format).and_then(|()| format.check_room(0)).map_err(|fault| fault.at_index(index))?;
    }
    format.end_array();
    Ok(())
}

/// A consumer that writes nothing.
struct Nothing;

impl OutputFormat for Nothing {
    const SKIPS: bool = true;
    fn literal(&mut self, _: &CodecPlan, _: &Literal) {}
    fn scalar(&mut self, _: Scalar, _: &[u8]) {}
    fn text(&mut self, _: &[u8]) -> Result<(), Fault> {
        Ok(())
    }
    fn bytes(&mut self, _: &[u8]) {}
    fn scalars(&mut self, _: Scalar, _: &[u8]) {}
    fn begin_array(&mut self, _: usize) {}
    fn element(&mut self, _: usize) {}
    fn end_array(&mut self) {}
    fn check_room(&self, _: usize) -> Result<(), Fault> {
        Ok(())
    }
}
