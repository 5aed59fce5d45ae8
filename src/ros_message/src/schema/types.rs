//! Resolved definitions.

use std::fmt;
use std::sync::{Arc, OnceLock};

use crate::RosVersion;
use crate::schema::description::type_hash;
use crate::schema::initial::Initial;
use crate::schema::plan::CodecPlan;
use crate::schema::primitive::Primitive;
use crate::schema::text::full_text;

/// Number of values in a field.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Arity {
    /// A single value.
    One,
    /// `[N]`: N values, without a length on the wire.
    Fixed(u32),
    /// `[]`: a four-byte length and that many values.
    Variable,
}

/// Bounds in a ROS 2 definition (`string<=8[<=3]`). Enforced when writing, but not when reading; nodes do not check
/// either.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FieldBounds {
    /// Maximum number of characters of the string, or of each string.
    pub text: Option<u32>,
    /// Maximum number of elements of an array of [`Arity::Variable`].
    pub elements: Option<u32>,
}

/// Type of a field's values.
#[derive(Debug, Clone)]
pub enum Base {
    /// A built-in type.
    Primitive(Primitive),
    /// A message.
    Message(Arc<MessageType>),
}

/// One field of a message.
#[derive(Debug, Clone)]
pub struct Field {
    /// Name in the definition.
    pub name: String,
    /// Type name without brackets and bounds, with references resolved: `byte`, `std_msgs/Header` (in ROS 2:
    /// `std_msgs/msg/Header`).
    pub type_name: String,
    /// Type of the field, or of each element.
    pub base: Base,
    /// Single value or array.
    pub arity: Arity,
    /// Bounds; none in ROS 1.
    pub bounds: FieldBounds,
    /// Default value in the definition, if any.
    pub(crate) initial: Option<Initial>,
}

impl Field {
    /// Returns the minimum size of the field in bytes, excluding padding; in ROS 1 its default is this many zeros.
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

    /// Returns true if the field always takes [`min_size`](Self::min_size) bytes plus padding.
    pub fn is_fixed_size(&self) -> bool {
        let one = match &self.base {
            Base::Primitive(primitive) => !matches!(primitive, Primitive::String | Primitive::Wstring),
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
    /// Name in the definition.
    pub name: String,
    /// Type name in the definition.
    pub type_name: String,
    /// Text to the right of `=`, without surrounding space, and without a comment unless the type is `string`; in ROS 2
    /// also without quotes.
    pub value: String,
}

/// A message with all references resolved.
pub struct MessageType {
    pub(crate) version: RosVersion,
    pub(crate) name: String,
    pub(crate) text: Arc<str>,
    /// Digest; in ROS 2 computed on first use, because it needs all dependencies.
    pub(crate) digest: OnceLock<String>,
    pub(crate) fields: Vec<Field>,
    pub(crate) constants: Vec<Constant>,
    pub(crate) plan: CodecPlan,
    pub(crate) full_text: OnceLock<String>,
}

impl MessageType {
    /// Returns the ROS version, which also determines the serialization format.
    pub fn version(&self) -> RosVersion {
        self.version
    }

    /// Returns the name `package/Type`; in ROS 2 `package/msg/Type`, or with `srv` or `action` if generated from one.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the digest that distinguishes it from other definitions of its name: the MD5 computed as in genmsg, 32
    /// lower-case hex digits; in ROS 2 the type hash, `RIHS01_` and 64 hex digits (REP 2016).
    pub fn digest(&self) -> &str {
        self.digest.get_or_init(|| type_hash(self))
    }

    /// Returns the digest, under the name it has in ROS 1.
    pub fn md5(&self) -> &str {
        self.digest()
    }

    /// Returns the text of the definition, as given.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// Returns the text followed by those of all dependencies, as `gendeps --cat` prints it and publishers send it.
    pub fn full_text(&self) -> &str {
        self.full_text.get_or_init(|| full_text(self))
    }

    /// Returns the fields in order of serialization.
    pub fn fields(&self) -> &[Field] {
        &self.fields
    }

    /// Returns the constants in order of definition.
    pub fn constants(&self) -> &[Constant] {
        &self.constants
    }

    /// Returns the minimum size of a message in bytes, excluding padding and ROS 2's encapsulation header. In ROS 1 the
    /// default message is this many zeros; [`default_message`](crate::codec::default_message) works for both.
    pub fn min_size(&self) -> usize {
        self.plan.min_size
    }

    /// Returns true if every message takes [`min_size`](Self::min_size) bytes plus padding.
    pub fn is_fixed_size(&self) -> bool {
        self.plan.fixed_size
    }

    /// Returns true if the first field is a `std_msgs/Header`.
    pub fn has_header(&self) -> bool {
        self.fields.first().is_some_and(|first| {
            first.arity == Arity::One && matches!(&first.base, Base::Message(message) if message.is_header())
        })
    }

    /// Returns true for `std_msgs/Header` itself.
    pub(crate) fn is_header(&self) -> bool {
        self.plan.header
    }
}

impl fmt::Debug for MessageType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.name, self.digest())
    }
}

/// A service with all references resolved.
#[derive(Debug, Clone)]
pub struct ServiceDef {
    /// `package/Type`; in ROS 2 `package/srv/Type`.
    pub name: String,
    /// Digest of request and response together: MD5, or ROS 2's type hash.
    pub md5: String,
    /// `package/TypeRequest`; in ROS 2 `package/srv/Type_Request`.
    pub request: Arc<MessageType>,
    /// `package/TypeResponse`; in ROS 2 `package/srv/Type_Response`.
    pub response: Arc<MessageType>,
}

/// An action and the messages generated from it. Field names follow ROS 1's genaction, whose message names begin with
/// the action's `Name`; ROS 2 has other messages for the same purposes.
#[derive(Debug, Clone)]
pub struct ActionDef {
    /// `package/Name`; in ROS 2 `package/action/Name`.
    pub name: String,
    /// `Action`: contains the three messages below that carry a goal id. In ROS 2 the action as a type, whose digest is
    /// the action's.
    pub action: Arc<MessageType>,
    /// `ActionGoal`: header, goal id, goal; the type of topic `goal`. In ROS 2 `_SendGoal_Request`: goal id, goal.
    pub action_goal: Arc<MessageType>,
    /// `ActionResult`: header, status, result; the type of topic `result`. In ROS 2 `_GetResult_Response`: status,
    /// result.
    pub action_result: Arc<MessageType>,
    /// `ActionFeedback`: header, status, feedback; the type of topic `feedback`. In ROS 2 `_FeedbackMessage`: goal id,
    /// feedback.
    pub action_feedback: Arc<MessageType>,
    /// `Goal`.
    pub goal: Arc<MessageType>,
    /// `Result`.
    pub result: Arc<MessageType>,
    /// `Feedback`.
    pub feedback: Arc<MessageType>,
    /// Services for sending goals and requesting results (ROS 2); `None` in ROS 1.
    pub services: Option<ActionServices>,
}

/// The services of a ROS 2 action, except the one for cancelling, whose type is the same for all actions.
#[derive(Debug, Clone)]
pub struct ActionServices {
    /// `package/action/Name_SendGoal`.
    pub send_goal: Arc<ServiceDef>,
    /// `package/action/Name_GetResult`.
    pub get_result: Arc<ServiceDef>,
}
