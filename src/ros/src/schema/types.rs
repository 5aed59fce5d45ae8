//! What a definition means once its references are resolved.

use std::fmt;
use std::sync::{Arc, OnceLock};

use crate::bus::RosVersion;
use crate::schema::description::type_hash;
use crate::schema::initial::Initial;
use crate::schema::plan::Plan;
use crate::schema::text::full_text;

/// The types that need no definition. `char` is [`Primitive::Uint8`]; `byte` is [`Primitive::Int8`] in ROS 1 and
/// [`Primitive::Uint8`] in ROS 2.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Primitive {
    /// One byte; anything but 0 is true.
    Bool,
    /// Also written `byte`.
    Int8,
    /// Also written `char`.
    Uint8,
    /// Two bytes; in ROS 1 little endian, as all that follow.
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
    /// `uint32 secs, uint32 nsecs`; ROS 1's own.
    Time,
    /// `int32 secs, int32 nsecs`; ROS 1's own.
    Duration,
    /// A four-byte length and so many units of UTF-16; ROS 2's own.
    Wstring,
}

impl Primitive {
    /// The primitive of this name in a version of ROS, aliases included.
    pub fn named(version: RosVersion, name: &str) -> Option<Primitive> {
        match (version, name) {
            (RosVersion::One, _) => Self::from_name(name),
            (RosVersion::Two, "byte") => Some(Primitive::Uint8),
            (RosVersion::Two, "wstring") => Some(Primitive::Wstring),
            (RosVersion::Two, "time" | "duration") => None,
            (RosVersion::Two, _) => Self::from_name(name),
        }
    }

    /// The primitive of this name in ROS 1, aliases included.
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
            Primitive::Wstring => "wstring",
        }
    }

    /// Serialized bytes; of a string, those of its length.
    pub fn size(self) -> usize {
        match self {
            Primitive::Bool | Primitive::Int8 | Primitive::Uint8 => 1,
            Primitive::Int16 | Primitive::Uint16 => 2,
            Primitive::Int32
            | Primitive::Uint32
            | Primitive::Float32
            | Primitive::String
            | Primitive::Wstring => 4,
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

/// What ROS 2 lets a definition bound (`string<=8[<=3]`). Writers keep to it; readers do not check, as nodes do not.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Bounds {
    /// Most characters of the text, or of each.
    pub text: Option<u32>,
    /// Most elements of an array of [`Arity::Variable`].
    pub elements: Option<u32>,
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
    /// Without brackets and bounds, references resolved: `byte`, `std_msgs/Header` (of ROS 2: `std_msgs/msg/Header`).
    pub type_name: String,
    /// The type of the field, or of each element.
    pub base: Base,
    /// Single value or array.
    pub arity: Arity,
    /// None in ROS 1.
    pub bounds: Bounds,
    /// What it holds until it is set, where the definition says so.
    pub(crate) initial: Option<Initial>,
}

impl Field {
    /// Fewest bytes the field takes, what alignment adds left out; in ROS 1 its default is as many zeros.
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

    /// Whether it always takes [`min_size`](Self::min_size) and what alignment adds.
    pub fn is_fixed_size(&self) -> bool {
        let one = match &self.base {
            Base::Primitive(primitive) => {
                !matches!(primitive, Primitive::String | Primitive::Wstring)
            }
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
    /// The text right of `=`, without surrounding space, and without a comment unless the type is `string`; of ROS 2
    /// without the quotes either.
    pub value: String,
}

/// A message, all references resolved.
pub struct MessageType {
    pub(crate) version: RosVersion,
    pub(crate) name: String,
    pub(crate) text: Arc<str>,
    /// Of ROS 2 only worked out when it is asked for: it needs all messages within.
    pub(crate) digest: OnceLock<String>,
    pub(crate) fields: Vec<Field>,
    pub(crate) constants: Vec<Constant>,
    pub(crate) plan: Plan,
    pub(crate) full_text: OnceLock<String>,
}

impl MessageType {
    /// Which ROS it is of, and so how its messages are serialized.
    pub fn version(&self) -> RosVersion {
        self.version
    }

    /// `package/Type`; of ROS 2 `package/msg/Type`, or with `srv` or `action` where it comes with one.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// What tells it from other definitions of its name: MD5 as genmsg computes it, 32 lower-case hex digits; of ROS 2
    /// the type hash, `RIHS01_` and 64 (REP 2016).
    pub fn digest(&self) -> &str {
        self.digest.get_or_init(|| type_hash(self))
    }

    /// The same, by the name that it has in ROS 1.
    pub fn md5(&self) -> &str {
        self.digest()
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

    /// Fewest bytes a message takes, what alignment adds and the header of ROS 2's serialization left out. In ROS 1 the
    /// default message is as many zeros; [`default_message`](crate::codec::default_message) knows it for both.
    pub fn min_size(&self) -> usize {
        self.plan.min_size
    }

    /// Whether every message takes [`min_size`](Self::min_size) bytes and what alignment adds.
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
        write!(f, "{} {}", self.name, self.digest())
    }
}

/// A service, all references resolved.
#[derive(Debug, Clone)]
pub struct ServiceDef {
    /// `package/Type`; of ROS 2 `package/srv/Type`.
    pub name: String,
    /// Digest of request and response together: MD5, or ROS 2's type hash.
    pub md5: String,
    /// `package/TypeRequest`; of ROS 2 `package/srv/Type_Request`.
    pub request: Arc<MessageType>,
    /// `package/TypeResponse`; of ROS 2 `package/srv/Type_Response`.
    pub response: Arc<MessageType>,
}

/// An action and the messages that its generator makes of it. Names are those of ROS 1's genaction, `Name` in front;
/// ROS 2 has others of the same use.
#[derive(Debug, Clone)]
pub struct ActionDef {
    /// `package/Name`; of ROS 2 `package/action/Name`.
    pub name: String,
    /// `Action`: the three below that say whose goal it is. Of ROS 2 the action as a type, whose digest is the action's.
    pub action: Arc<MessageType>,
    /// `ActionGoal`: header, goal id, goal; the type of topic `goal`. Of ROS 2 `_SendGoal_Request`: goal id, goal.
    pub action_goal: Arc<MessageType>,
    /// `ActionResult`: header, status, result; the type of topic `result`. Of ROS 2 `_GetResult_Response`: status, result.
    pub action_result: Arc<MessageType>,
    /// `ActionFeedback`: header, status, feedback; the type of topic `feedback`. Of ROS 2 `_FeedbackMessage`: goal id,
    /// feedback.
    pub action_feedback: Arc<MessageType>,
    /// `Goal`.
    pub goal: Arc<MessageType>,
    /// `Result`.
    pub result: Arc<MessageType>,
    /// `Feedback`.
    pub feedback: Arc<MessageType>,
    /// What ROS 2 sends goals and asks for results by; none in ROS 1.
    pub services: Option<ActionServices>,
}

/// The services of a ROS 2 action, beside the one that cancels, whose type all actions share.
#[derive(Debug, Clone)]
pub struct ActionServices {
    /// `package/action/Name_SendGoal`.
    pub send_goal: Arc<ServiceDef>,
    /// `package/action/Name_GetResult`.
    pub get_result: Arc<ServiceDef>,
}
