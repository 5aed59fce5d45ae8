//! What a definition means once its references are resolved.

use std::fmt;
use std::sync::{Arc, OnceLock};

use crate::schema::plan::Plan;
use crate::schema::text::full_text;

/// The types that need no definition. `byte` is [`Primitive::Int8`] and `char` is [`Primitive::Uint8`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Primitive {
    /// One byte; anything but 0 is true.
    Bool,
    /// Also written `byte`.
    Int8,
    /// Also written `char`.
    Uint8,
    /// Two bytes, little endian, as all that follow.
    Int16,
    /// Two bytes.
    Uint16,
    /// Four bytes.
    Int32,
    /// Four bytes.
    Uint32,
    /// Eight bytes.
    Int64,
    /// Eight bytes.
    Uint64,
    /// IEEE 754 single.
    Float32,
    /// IEEE 754 double.
    Float64,
    /// A four-byte length and so many bytes, UTF-8 by custom.
    String,
    /// `uint32 secs, uint32 nsecs`.
    Time,
    /// `int32 secs, int32 nsecs`.
    Duration,
}

impl Primitive {
    /// The primitive of this name, aliases included.
    pub fn from_name(name: &str) -> Option<Primitive> {
        Some(match name {
            "bool" => Primitive::Bool,
            "int8" | "byte" => Primitive::Int8,
            "uint8" | "char" => Primitive::Uint8,
            "int16" => Primitive::Int16,
            "uint16" => Primitive::Uint16,
            "int32" => Primitive::Int32,
            "uint32" => Primitive::Uint32,
            "int64" => Primitive::Int64,
            "uint64" => Primitive::Uint64,
            "float32" => Primitive::Float32,
            "float64" => Primitive::Float64,
            "string" => Primitive::String,
            "time" => Primitive::Time,
            "duration" => Primitive::Duration,
            _ => return None,
        })
    }

    /// Its ROS name.
    pub fn name(self) -> &'static str {
        match self {
            Primitive::Bool => "bool",
            Primitive::Int8 => "int8",
            Primitive::Uint8 => "uint8",
            Primitive::Int16 => "int16",
            Primitive::Uint16 => "uint16",
            Primitive::Int32 => "int32",
            Primitive::Uint32 => "uint32",
            Primitive::Int64 => "int64",
            Primitive::Uint64 => "uint64",
            Primitive::Float32 => "float32",
            Primitive::Float64 => "float64",
            Primitive::String => "string",
            Primitive::Time => "time",
            Primitive::Duration => "duration",
        }
    }

    /// Serialized bytes; of a string, those of its length.
    pub fn size(self) -> usize {
        match self {
            Primitive::Bool | Primitive::Int8 | Primitive::Uint8 => 1,
            Primitive::Int16 | Primitive::Uint16 => 2,
            Primitive::Int32 | Primitive::Uint32 | Primitive::Float32 | Primitive::String => 4,
            Primitive::Int64
            | Primitive::Uint64
            | Primitive::Float64
            | Primitive::Time
            | Primitive::Duration => 8,
        }
    }
}

/// How many values a field holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Arity {
    /// One value, no array.
    One,
    /// `[N]`: N values, without a length on the wire.
    Fixed(u32),
    /// `[]`: a four-byte length and so many values.
    Variable,
}

/// What a field's values are.
#[derive(Debug, Clone)]
pub enum Base {
    /// Built in.
    Primitive(Primitive),
    /// Another message.
    Message(Arc<MessageType>),
}

/// One field of a message.
#[derive(Debug, Clone)]
pub struct Field {
    /// As in the definition.
    pub name: String,
    /// Without brackets, references resolved: `byte`, `std_msgs/Header`.
    pub type_name: String,
    /// The type of the field, or of each element.
    pub base: Base,
    /// Single value or array.
    pub arity: Arity,
}

impl Field {
    /// Fewest bytes the field takes; its default is as many zeros.
    pub fn min_size(&self) -> usize {
        let one = match &self.base {
            Base::Primitive(primitive) => primitive.size(),
            Base::Message(message) => message.min_size(),
        };
        match self.arity {
            Arity::One => one,
            Arity::Fixed(count) => one.saturating_mul(count as usize),
            Arity::Variable => 4,
        }
    }

    /// Whether it always takes [`min_size`](Self::min_size).
    pub fn is_fixed_size(&self) -> bool {
        let one = match &self.base {
            Base::Primitive(primitive) => *primitive != Primitive::String,
            Base::Message(message) => message.is_fixed_size(),
        };
        match self.arity {
            Arity::One => one,
            Arity::Fixed(count) => one || count == 0,
            Arity::Variable => false,
        }
    }
}

/// One constant of a message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Constant {
    /// As in the definition.
    pub name: String,
    /// As in the definition.
    pub type_name: String,
    /// The text right of `=`, without surrounding space, and without a comment unless the type is `string`.
    pub value: String,
}

/// A message, all references resolved.
pub struct MessageType {
    pub(crate) name: String,
    pub(crate) text: Arc<str>,
    pub(crate) md5: String,
    pub(crate) fields: Vec<Field>,
    pub(crate) constants: Vec<Constant>,
    pub(crate) plan: Plan,
    pub(crate) full_text: OnceLock<String>,
}

impl MessageType {
    /// `package/Type`.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// MD5 as genmsg computes it, 32 lower-case hex digits.
    pub fn md5(&self) -> &str {
        &self.md5
    }

    /// Its own text, as given.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// Its text followed by those of all messages it contains, as `gendeps --cat` prints it and publishers send it.
    pub fn full_text(&self) -> &str {
        self.full_text.get_or_init(|| full_text(self))
    }

    /// In order of serialization.
    pub fn fields(&self) -> &[Field] {
        &self.fields
    }

    /// In order of definition.
    pub fn constants(&self) -> &[Constant] {
        &self.constants
    }

    /// Fewest bytes a message takes; the default message is as many zeros.
    pub fn min_size(&self) -> usize {
        self.plan.min_size
    }

    /// Whether every message takes [`min_size`](Self::min_size) bytes.
    pub fn is_fixed_size(&self) -> bool {
        self.plan.fixed_size
    }

    /// Whether the first field is a `std_msgs/Header`.
    pub fn has_header(&self) -> bool {
        self.fields.first().is_some_and(|first| {
            first.arity == Arity::One
                && matches!(&first.base, Base::Message(message) if message.is_header())
        })
    }

    /// Whether this is `std_msgs/Header` itself.
    pub(crate) fn is_header(&self) -> bool {
        self.plan.header
    }
}

impl fmt::Debug for MessageType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.name, self.md5)
    }
}

/// A service, all references resolved.
#[derive(Debug, Clone)]
pub struct ServiceDef {
    /// `package/Type`.
    pub name: String,
    /// MD5 of request and response together.
    pub md5: String,
    /// `package/TypeRequest`.
    pub request: Arc<MessageType>,
    /// `package/TypeResponse`.
    pub response: Arc<MessageType>,
}

/// An action and the seven messages that genaction makes of it.
#[derive(Debug, Clone)]
pub struct ActionDef {
    /// `package/Name`.
    pub name: String,
    /// `NameAction`: the three below that have a header.
    pub action: Arc<MessageType>,
    /// `NameActionGoal`: header, goal id, goal; the type of topic `goal`.
    pub action_goal: Arc<MessageType>,
    /// `NameActionResult`: header, status, result; the type of topic `result`.
    pub action_result: Arc<MessageType>,
    /// `NameActionFeedback`: header, status, feedback; the type of topic `feedback`.
    pub action_feedback: Arc<MessageType>,
    /// `NameGoal`.
    pub goal: Arc<MessageType>,
    /// `NameResult`.
    pub result: Arc<MessageType>,
    /// `NameFeedback`.
    pub feedback: Arc<MessageType>,
}
