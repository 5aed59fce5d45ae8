//! What is wrong with a frame, said so that the client's author can fix it.

use crate::Id;

/// A frame that cannot be understood. Where op and id could still be read they are kept: the status message that
/// answers names them.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{}{problem}", prefix(.op))]
pub struct Error {
    /// The op, where it could be read.
    pub op: Option<String>,
    /// The interaction's id, where it could be read.
    pub id: Option<Id<'static>>,
    /// What is wrong.
    pub problem: Problem,
}

fn prefix(op: &Option<String>) -> String {
    op.as_ref().map(|op| format!("{op}: ")).unwrap_or_default()
}

impl Error {
    pub(crate) fn new(problem: Problem) -> Self {
        Self {
            op: None,
            id: None,
            problem,
        }
    }
}

impl From<Problem> for Error {
    fn from(problem: Problem) -> Self {
        Self::new(problem)
    }
}

/// The kinds of mistakes in a frame.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Problem {
    /// Not JSON, or not CBOR.
    #[error("invalid {format} at byte {at}: {reason}")]
    Syntax {
        /// `JSON` or `CBOR`.
        format: &'static str,
        /// Offset in the frame.
        at: usize,
        /// What was expected there.
        reason: &'static str,
    },
    /// Valid, but no object.
    #[error("a frame must be one {0}")]
    NotAnObject(&'static str),
    /// An object with too many fields to be a rosbridge message.
    #[error("a message has at most {0} fields")]
    TooManyFields(usize),
    /// No `op`.
    #[error("field \"op\" is missing; it must be one of {known}{hint}", known = crate::op::KNOWN.join(", "))]
    NoOp {
        /// For clients of rosbridge 1.0.
        hint: &'static str,
    },
    /// An `op` that the protocol does not know.
    #[error("unknown op {0:?}; known are {known}", known = crate::op::KNOWN.join(", "))]
    UnknownOp(String),
    /// A required field is absent.
    #[error("field {field:?} is missing, {expected} is expected")]
    Missing {
        /// The field.
        field: &'static str,
        /// What it should be.
        expected: &'static str,
    },
    /// A field has a value of another kind.
    #[error("field {field:?} is {found}, {expected} is expected")]
    Mistyped {
        /// The field.
        field: &'static str,
        /// What it should be.
        expected: &'static str,
        /// What it is, shortened.
        found: String,
    },
    /// A field is longer than it may be.
    #[error("field {field:?} has {length} bytes, at most {limit} are allowed")]
    TooLong {
        /// The field.
        field: &'static str,
        /// How long it is.
        length: usize,
        /// How long it may be.
        limit: usize,
    },
}
