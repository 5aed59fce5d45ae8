//! What goes wrong, and where: the place is put together on the way out, so the way in pays nothing for it.

use std::fmt;

use crate::schema::MessageType;

/// Why a conversion failed, and at which field.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CodecError {
    /// The message type being converted; empty where none is involved.
    pub type_name: String,
    /// The field, from the message's top: `header.stamp`, `poses[3].position.x`; empty for the message itself.
    pub path: String,
    /// What is wrong with it.
    pub kind: CodecErrorKind,
}

impl fmt::Display for CodecError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (&*self.type_name, &*self.path) {
            ("", _) => write!(f, "{}", self.kind),
            (type_name, "") => write!(f, "{type_name}: {}", self.kind),
            (type_name, path) => write!(f, "field {path} of {type_name}: {}", self.kind),
        }
    }
}

impl CodecError {
    /// An error of input that belongs to no message type.
    pub(crate) fn of_input(kind: CodecErrorKind) -> CodecError {
        CodecError {
            type_name: String::new(),
            path: String::new(),
            kind,
        }
    }
}

impl std::error::Error for CodecError {}

/// What can be wrong with a field, or with the whole input.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CodecErrorKind {
    /// The serialized message ends inside a value.
    #[error("the serialized message ends here, {missing} bytes too early")]
    Truncated {
        /// Bytes that are missing.
        missing: usize,
    },
    /// The serialized message goes on after its last field.
    #[error("{0} bytes follow the end of the message")]
    Trailing(
        /// Bytes after the last field.
        usize,
    ),
    /// A string's or an array's length cannot be true.
    #[error("a length of {count} cannot be true with {left} bytes to follow")]
    LengthBeyondEnd {
        /// The length that the input declares.
        count: u64,
        /// Bytes after the length.
        left: usize,
    },
    /// A string is not UTF-8.
    #[error("the text is not UTF-8")]
    InvalidUtf8,
    /// A value of another kind than the field's.
    #[error("takes {expected}, got {found}")]
    Mismatch {
        /// What the field takes.
        expected: &'static str,
        /// The kind of value that was found.
        found: &'static str,
    },
    /// A number that the field cannot hold.
    #[error("{found} does not fit into {expected}")]
    OutOfRange {
        /// The field's type.
        expected: &'static str,
        /// The number that does not fit.
        found: String,
    },
    /// The path names a field that the type does not have.
    #[error("there is no such field")]
    NoSuchField,
    /// A fixed array with another number of elements.
    #[error("takes exactly {expected} elements, got {found}")]
    WrongLength {
        /// The length that the definition fixes.
        expected: usize,
        /// As given; at least, where counting stopped there.
        found: usize,
    },
    /// More elements, or characters, than the definition lets there be.
    #[error("takes at most {most} {of}, got {found}")]
    TooMany {
        /// The bound of the definition.
        most: usize,
        /// What is counted.
        of: &'static str,
        /// As given; at least, where counting stopped there.
        found: usize,
    },
    /// A way of serializing that ROS 2's nodes do not use.
    #[error(
        "serialized as representation {0:#06x}, of which only plain CDR is read (0x0000 and 0x0001)"
    )]
    Representation(
        /// The first two bytes of the message (DDS-XTypes 1.3, table 60).
        u16,
    ),
    /// Bytes given as text that is not base64.
    #[error("the text is not base64")]
    Base64,
    /// The input is not JSON.
    #[error("invalid JSON at byte {at}: {reason}")]
    Json {
        /// From the beginning of the input.
        at: usize,
        /// What was expected or found.
        reason: &'static str,
    },
    /// The input is not CBOR.
    #[error("invalid CBOR at byte {at}: {reason}")]
    Cbor {
        /// From the beginning of the input.
        at: usize,
        /// What was expected or found.
        reason: &'static str,
    },
    /// The input nests too deeply.
    #[error("nested deeper than {0} levels")]
    TooDeep(
        /// Levels of nesting that are accepted.
        usize,
    ),
    /// The output would grow beyond what was allowed.
    #[error("the converted message is larger than the limit of {0} bytes")]
    TooLarge(
        /// Most bytes that may be written.
        usize,
    ),
}

/// An error on its way out, gathering its place. Boxed: results on the hot path stay one word.
#[derive(Debug)]
pub(crate) struct Fault(Box<Inner>);

#[derive(Debug)]
struct Inner {
    kind: CodecErrorKind,
    /// Innermost first.
    place: Vec<Segment>,
}

#[derive(Debug)]
enum Segment {
    Field(String),
    Index(usize),
}

impl From<CodecErrorKind> for Fault {
    #[cold]
    fn from(kind: CodecErrorKind) -> Fault {
        Fault(Box::new(Inner {
            kind,
            place: Vec::new(),
        }))
    }
}

impl Fault {
    pub(crate) fn is_out_of_range(&self) -> bool {
        matches!(self.0.kind, CodecErrorKind::OutOfRange { .. })
    }

    #[cold]
    pub(crate) fn in_field(mut self, name: &str) -> Fault {
        self.0.place.push(Segment::Field(name.to_owned()));
        self
    }

    #[cold]
    pub(crate) fn at_index(mut self, index: usize) -> Fault {
        self.0.place.push(Segment::Index(index));
        self
    }

    #[cold]
    pub(crate) fn of(self, message: &MessageType) -> CodecError {
        let mut path = String::new();
        for segment in self.0.place.iter().rev() {
            match segment {
                Segment::Field(name) if path.is_empty() => path.push_str(name),
                Segment::Field(name) => {
                    path.push('.');
                    path.push_str(name);
                }
                Segment::Index(index) => path.push_str(&format!("[{index}]")),
            }
        }
        CodecError {
            type_name: message.name().to_owned(),
            path,
            kind: self.0.kind,
        }
    }
}

/// A value of the wrong kind.
#[cold]
pub(crate) fn mismatch(expected: &'static str, found: &'static str) -> Fault {
    CodecErrorKind::Mismatch { expected, found }.into()
}
