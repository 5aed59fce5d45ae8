//! Errors of frames, worded so that the author of a client can fix them.

use crate::Id;

/// A frame that cannot be understood. Op and id are included if they could be read: the status message that answers the
/// frame names them.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{}{problem}", prefix(.op))]
pub struct Error {
    /// The op, if it could be read.
    pub op: Option<String>,
    /// Id of the interaction, if it could be read.
    pub id: Option<Id<'static>>,
    /// The mistake in the frame.
    pub problem: Problem,
}

fn prefix(op: &Option<String>) -> String {
    op.as_ref().map(|op| format!("{op}: ")).unwrap_or_default()
}

impl Error {
    pub(crate) fn new(problem: Problem) -> Self {
        Self { op: None, id: None, problem }
    }
}

impl From<Problem> for Error {
    fn from(problem: Problem) -> Self {
        Self::new(problem)
    }
}

/// Kinds of mistakes in a frame.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Problem {
    /// The frame is not JSON, or not CBOR.
    #[error("invalid {format} at byte {at}: {reason}")]
    Syntax {
        /// `JSON` or `CBOR`.
        format: &'static str,
        /// Byte offset in the frame.
        at: usize,
        /// Description of what was expected there.
        reason: &'static str,
    },
    /// Valid, but not an object.
    #[error("a frame must be one {0}")]
    NotAnObject(&'static str),
    /// An object with too many fields to be a rosbridge message.
    #[error("a message has at most {0} fields")]
    TooManyFields(usize),
    /// The frame has no `op`.
    #[error("field \"op\" is missing; it must be one of {names}{hint}", names = .known.join(", "))]
    NoOp {
        /// Names of all ops.
        known: &'static [&'static str],
        /// Hint for clients of rosbridge 1.0.
        hint: &'static str,
    },
    /// The `op` is not part of the protocol.
    #[error("unknown op {op:?}; known are {names}", names = .known.join(", "))]
    UnknownOp {
        /// The op, shortened.
        op: String,
        /// Names of all ops.
        known: &'static [&'static str],
    },
    /// A required field is absent.
    #[error("field {field:?} is missing, {expected} is expected")]
    Missing {
        /// Name of the field.
        field: &'static str,
        /// Expected content.
        expected: &'static str,
    },
    /// A field has a value of the wrong type.
    #[error("field {field:?} is {found}, {expected} is expected")]
    Mistyped {
        /// Name of the field.
        field: &'static str,
        /// Expected content.
        expected: &'static str,
        /// The value found, shortened.
        found: String,
    },
    /// A field is longer than allowed.
    #[error("field {field:?} has {length} bytes, at most {limit} are allowed")]
    TooLong {
        /// Name of the field.
        field: &'static str,
        /// Length in bytes.
        length: usize,
        /// Maximum length in bytes.
        limit: usize,
    },
}
