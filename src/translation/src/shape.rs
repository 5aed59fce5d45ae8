//! Serialized forms of values, as far as they must be known to step over them.

use std::collections::HashMap;
use std::sync::Arc;

use ros_message::RosVersion;
use ros_message::codec::cursor::MessageCursor;
use ros_message::codec::{CodecErrorKind, Fault};
use ros_message::schema::{Arity, Base, Field, FieldBounds, MessageType, Primitive};

/// Maximum length of an array whose elements have no bytes: such elements cost nothing on the wire.
const MAX_EMPTY_ELEMENTS: usize = 1 << 16;

/// Number of elements of an array.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Count {
    /// No length on the wire.
    Fixed(usize),
    /// A length of four bytes; the definition allows `most`.
    Variable { most: usize },
}

/// The serialized form of a value.
#[derive(Debug, Clone)]
pub(crate) enum Shape {
    /// `bytes` bytes in numbers of `width`, one behind the other.
    Numbers { width: usize, bytes: usize },
    /// A length and that many bytes, or UTF-16 units.
    Text { wide: bool },
    /// Elements of at least `min_size` bytes each.
    Array { count: Count, min_size: usize, element: Box<Shape> },
    /// Fields in order.
    Message(Arc<[Shape]>),
}

/// A field, or a message as a whole: what is paired and carried.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Slot<'a> {
    pub(crate) base: SlotBase<'a>,
    pub(crate) arity: Arity,
    pub(crate) bounds: FieldBounds,
    /// Type in the definition, without brackets.
    pub(crate) type_name: &'a str,
}

/// Type of a slot, or of its elements.
#[derive(Debug, Clone, Copy)]
pub(crate) enum SlotBase<'a> {
    Primitive(Primitive),
    Message(&'a MessageType),
}

impl<'a> Slot<'a> {
    pub(crate) fn from_field(field: &'a Field) -> Slot<'a> {
        let base = match &field.base {
            Base::Primitive(primitive) => SlotBase::Primitive(*primitive),
            Base::Message(message) => SlotBase::Message(message),
        };
        Slot { base, arity: field.arity, bounds: field.bounds, type_name: &field.type_name }
    }

    /// Returns the slot at a path of field indices; the message itself for an empty path. `None` if a field on the way
    /// is no single message.
    pub(crate) fn at_path(message: &'a MessageType, path: &[usize]) -> Option<Slot<'a>> {
        let whole = Slot {
            base: SlotBase::Message(message),
            arity: Arity::One,
            bounds: FieldBounds::default(),
            type_name: message.name(),
        };
        path.iter().try_fold(whole, |slot, index| {
            let SlotBase::Message(message) = slot.base else {
                return None;
            };
            let field = message.fields().get(*index).filter(|_| slot.arity == Arity::One)?;
            Some(Slot::from_field(field))
        })
    }

    /// Returns the number of elements; `None` for a single value.
    pub(crate) fn count(&self) -> Option<Count> {
        match self.arity {
            Arity::One => None,
            Arity::Fixed(count) => Some(Count::Fixed(count as usize)),
            Arity::Variable => {
                Some(Count::Variable { most: self.bounds.elements.map_or(usize::MAX, |most| most as usize) })
            }
        }
    }

    /// Returns the minimum size of one element in bytes, without padding.
    pub(crate) fn element_min_size(&self) -> usize {
        match self.base {
            SlotBase::Primitive(primitive) => primitive.size(),
            SlotBase::Message(message) => message.min_size(),
        }
    }

    /// Returns the type as a definition writes it.
    pub(crate) fn definition_text(&self) -> String {
        let bound = self.bounds.text.map(|most| format!("<={most}")).unwrap_or_default();
        let brackets = match (self.arity, self.bounds.elements) {
            (Arity::One, _) => String::new(),
            (Arity::Fixed(count), _) => format!("[{count}]"),
            (Arity::Variable, None) => "[]".to_owned(),
            (Arity::Variable, Some(most)) => format!("[<={most}]"),
        };
        format!("{}{bound}{brackets}", self.type_name)
    }
}

/// Returns the width of the numbers that a primitive of fixed size consists of.
pub(crate) fn number_width(primitive: Primitive) -> usize {
    match primitive {
        Primitive::Time | Primitive::Duration => 4,
        other => other.size(),
    }
}

/// Makes shapes, and keeps those of messages: definitions may mention one message exponentially often.
#[derive(Debug)]
pub(crate) struct Shapes {
    version: RosVersion,
    messages: HashMap<String, Arc<[Shape]>>,
}

impl Shapes {
    pub(crate) fn new(version: RosVersion) -> Shapes {
        Shapes { version, messages: HashMap::new() }
    }

    pub(crate) fn slot(&mut self, slot: &Slot<'_>) -> Shape {
        let element = match slot.base {
            SlotBase::Primitive(Primitive::String) => Shape::Text { wide: false },
            SlotBase::Primitive(Primitive::Wstring) => Shape::Text { wide: true },
            SlotBase::Primitive(primitive) => {
                Shape::Numbers { width: number_width(primitive), bytes: primitive.size() }
            }
            SlotBase::Message(message) => {
                let fields = self.message(message);
                match &*fields {
                    [one @ Shape::Numbers { .. }] => one.clone(),
                    _ => Shape::Message(fields),
                }
            }
        };
        match (slot.count(), element) {
            (None, element) => element,
            (Some(Count::Fixed(count)), Shape::Numbers { width, bytes }) => {
                Shape::Numbers { width, bytes: bytes.saturating_mul(count) }
            }
            (Some(count), element) => {
                Shape::Array { count, min_size: slot.element_min_size(), element: Box::new(element) }
            }
        }
    }

    fn message(&mut self, message: &MessageType) -> Arc<[Shape]> {
        if let Some(known) = self.messages.get(message.name()) {
            return known.clone();
        }
        let mut shapes = Vec::new();
        if self.version == RosVersion::One && message.is_fixed_size() {
            // Without alignment the fields are one block.
            shapes.push(Shape::Numbers { width: 1, bytes: message.min_size() });
        } else {
            for field in message.fields() {
                let shape = self.slot(&Slot::from_field(field));
                push_shape(&mut shapes, shape);
            }
            if is_placeholder(message) {
                shapes.push(PLACEHOLDER);
            }
        }
        let shapes: Arc<[Shape]> = shapes.into();
        self.messages.insert(message.name().to_owned(), shapes.clone());
        shapes
    }
}

/// The byte that stands for a type without fields in ROS 2.
pub(crate) const PLACEHOLDER: Shape = Shape::Numbers { width: 1, bytes: 1 };

/// Returns true if the message is serialized as [`PLACEHOLDER`].
pub(crate) fn is_placeholder(message: &MessageType) -> bool {
    message.version() == RosVersion::Two && message.fields().is_empty()
}

/// Appends a shape, joined to the last one if both are numbers of one width: there is no padding between them.
fn push_shape(shapes: &mut Vec<Shape>, shape: Shape) {
    if let (Some(Shape::Numbers { width, bytes }), Shape::Numbers { width: more_width, bytes: more }) =
        (shapes.last_mut(), &shape)
    {
        if width == more_width && *bytes > 0 && *more > 0 {
            *bytes = bytes.saturating_add(*more);
            return;
        }
    }
    shapes.push(shape);
}

impl Shape {
    /// Moves the cursor behind the value, and gives its pieces to `visit`: the width of their numbers, and the bytes.
    pub(crate) fn walk(
        &self,
        cursor: &mut MessageCursor<'_>,
        visit: &mut dyn FnMut(usize, &[u8]),
    ) -> Result<(), Fault> {
        match self {
            // Nothing is padded where nothing is written.
            Shape::Numbers { bytes: 0, .. } => Ok(()),
            Shape::Numbers { width, bytes } => {
                visit(*width, take(cursor, *bytes, *width)?);
                Ok(())
            }
            Shape::Text { wide } => {
                let (length, bytes) = take_text(cursor, *wide)?;
                visit(4, &length.to_le_bytes());
                visit(if *wide { 4 } else { 1 }, bytes);
                Ok(())
            }
            Shape::Array { count, min_size, element } => {
                let length = take_count(cursor, *count, *min_size)?;
                if let Count::Variable { .. } = count {
                    visit(4, &(length as u32).to_le_bytes());
                }
                if let Shape::Numbers { width, bytes } = **element {
                    let block = Shape::Numbers { width, bytes: bytes.saturating_mul(length) };
                    return block.walk(cursor, visit);
                }
                for index in 0..length {
                    element.walk(cursor, visit).map_err(|fault| fault.at_index(index))?;
                }
                Ok(())
            }
            Shape::Message(fields) => fields.iter().try_for_each(|field| field.walk(cursor, visit)),
        }
    }

    /// Moves the cursor behind the value.
    pub(crate) fn skip(&self, cursor: &mut MessageCursor<'_>) -> Result<(), Fault> {
        self.walk(cursor, &mut |_, _| ())
    }
}

/// Takes `size` bytes behind padding to `alignment`.
#[inline]
pub(crate) fn take<'a>(cursor: &mut MessageCursor<'a>, size: usize, alignment: usize) -> Result<&'a [u8], Fault> {
    match cursor.take(size, alignment) {
        Some(taken) => Ok(taken),
        None => Err(truncation_fault(cursor, size)),
    }
}

/// Takes the length of a text and its bytes or UTF-16 units, in ROS 2 with the NUL at its end.
#[inline]
pub(crate) fn take_text<'a>(cursor: &mut MessageCursor<'a>, wide: bool) -> Result<(u32, &'a [u8]), Fault> {
    let Some(length) = cursor.number().map(u32::from_le_bytes) else {
        return Err(truncation_fault(cursor, 4));
    };
    let unit = if wide { 4 } else { 1 };
    let size = (length as usize).saturating_mul(unit);
    if size > cursor.remaining() {
        return Err(CodecErrorKind::LengthBeyondEnd { count: length.into(), left: cursor.remaining() }.into());
    }
    Ok((length, take(cursor, size, unit)?))
}

/// Takes the number of elements of an array, each of at least `min_size` bytes; at least so many bytes follow.
#[inline]
pub(crate) fn take_count(cursor: &mut MessageCursor<'_>, count: Count, min_size: usize) -> Result<usize, Fault> {
    let length = match count {
        Count::Fixed(length) => length,
        Count::Variable { .. } => match cursor.length() {
            Some(length) => length,
            None => return Err(truncation_fault(cursor, 4)),
        },
    };
    let fits = match min_size {
        0 => matches!(count, Count::Fixed(_)) || length <= MAX_EMPTY_ELEMENTS,
        _ => length.checked_mul(min_size).is_some_and(|size| size <= cursor.remaining()),
    };
    if !fits {
        return Err(CodecErrorKind::LengthBeyondEnd { count: length as u64, left: cursor.remaining() }.into());
    }
    Ok(length)
}

#[cold]
fn truncation_fault(cursor: &MessageCursor<'_>, size: usize) -> Fault {
    // Padding may be missing too.
    let missing = size.saturating_sub(cursor.remaining()).max(1);
    CodecErrorKind::Truncated { missing }.into()
}
