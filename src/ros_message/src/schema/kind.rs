//! Kinds of field contents distinguished by the codec.

use std::sync::Arc;

use crate::schema::{Arity, Base, Field, MessageType, Primitive};

/// Content of one field.
#[derive(Debug, Clone)]
pub(crate) enum Kind {
    Scalar(Scalar),
    Text(Text),
    /// `uint8` and `char` arrays.
    Bytes(Count),
    /// Arrays of all other scalars.
    Scalars(Scalar, Count),
    Texts(Text, Count),
    Struct(Arc<MessageType>),
    Structs(Arc<MessageType>, Count),
}

/// Properties of a string.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Text {
    /// True for UTF-16 units, false for bytes.
    pub(crate) wide: bool,
    /// Maximum number of characters, or [`Text::UNBOUNDED`].
    pub(crate) most: u32,
}

/// Number of elements of an array.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Count {
    Fixed(usize),
    Variable,
    /// Variable, with a maximum.
    Bounded(usize),
}

/// Values of a fixed size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Scalar {
    Bool,
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
    /// ROS 1's time.
    Time,
    Duration,
    /// `builtin_interfaces/msg/Time`.
    Time2,
    /// `builtin_interfaces/msg/Duration`.
    Duration2,
}

impl Scalar {
    pub(crate) fn size(self) -> usize {
        match self {
            Scalar::Bool | Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::I64 | Scalar::U64 | Scalar::F64 => 8,
            Scalar::Time | Scalar::Duration | Scalar::Time2 | Scalar::Duration2 => 8,
        }
    }

    /// Returns the alignment: the size of the largest number contained.
    pub(crate) fn alignment(self) -> usize {
        match self {
            Scalar::Time | Scalar::Duration | Scalar::Time2 | Scalar::Duration2 => 4,
            other => other.size(),
        }
    }

    fn from_primitive(primitive: Primitive) -> Option<Scalar> {
        Some(match primitive {
            Primitive::Bool => Scalar::Bool,
            Primitive::Int8 => Scalar::I8,
            Primitive::Uint8 => Scalar::U8,
            Primitive::Int16 => Scalar::I16,
            Primitive::Uint16 => Scalar::U16,
            Primitive::Int32 => Scalar::I32,
            Primitive::Uint32 => Scalar::U32,
            Primitive::Int64 => Scalar::I64,
            Primitive::Uint64 => Scalar::U64,
            Primitive::Float32 => Scalar::F32,
            Primitive::Float64 => Scalar::F64,
            Primitive::Time => Scalar::Time,
            Primitive::Duration => Scalar::Duration,
            Primitive::String | Primitive::Wstring => return None,
        })
    }
}

impl Count {
    /// Returns the maximum number of elements.
    pub(crate) fn max_count(self) -> usize {
        match self {
            Count::Fixed(count) | Count::Bounded(count) => count,
            Count::Variable => usize::MAX,
        }
    }
}

impl Text {
    pub(crate) const UNBOUNDED: u32 = u32::MAX;

    fn from_field(field: &Field, primitive: Primitive) -> Text {
        Text { wide: primitive == Primitive::Wstring, most: field.bounds.text.unwrap_or(Self::UNBOUNDED) }
    }
}

impl Kind {
    pub(super) fn from_field(field: &Field) -> Kind {
        let count = match field.arity {
            Arity::One => None,
            Arity::Fixed(count) => Some(Count::Fixed(count as usize)),
            Arity::Variable => Some(match field.bounds.elements {
                Some(most) => Count::Bounded(most as usize),
                None => Count::Variable,
            }),
        };
        if let Base::Message(message) = &field.base {
            match (message.plan.scalar, count) {
                (None, _) => {}
                (Some(scalar), None) => return Kind::Scalar(scalar),
                (Some(scalar), Some(count)) => return Kind::Scalars(scalar, count),
            }
        }
        match (&field.base, count) {
            (Base::Message(message), None) => Kind::Struct(message.clone()),
            (Base::Message(message), Some(count)) => Kind::Structs(message.clone(), count),
            (Base::Primitive(primitive), count) => match (Scalar::from_primitive(*primitive), count) {
                (None, None) => Kind::Text(Text::from_field(field, *primitive)),
                (None, Some(count)) => Kind::Texts(Text::from_field(field, *primitive), count),
                (Some(Scalar::U8), Some(count)) => Kind::Bytes(count),
                (Some(scalar), None) => Kind::Scalar(scalar),
                (Some(scalar), Some(count)) => Kind::Scalars(scalar, count),
            },
        }
    }
}
