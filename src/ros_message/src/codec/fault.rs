//! Errors of conversions and their locations. The path is assembled while an error propagates, so successful
//! conversions pay nothing for it.

use std::fmt;

/// An error in a conversion, with the field concerned.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CodecError {
    /// The message type being converted; empty if none is involved.
    pub type_name: String,
    /// Path of the field from the top of the message: `header.stamp`, `poses[3].position.x`; empty for the message
    /// itself.
    pub path: String,
    /// The problem.
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
    /// Creates an error of input that belongs to no message type.
    pub(crate) fn from_input(kind: CodecErrorKind) -> CodecError {
        CodecError { type_name: String::new(), path: String::new(), kind }
    }
}

impl std::error::Error for CodecError {}

/// Problems of a field or of the whole input.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CodecErrorKind {
    /// The serialized message ends inside a value.
    #[error("the serialized message ends here, {missing} bytes too early")]
    Truncated {
        /// Number of missing bytes.
        missing: usize,
    },
    /// The serialized message continues after its last field.
    #[error("{0} bytes follow the end of the message")]
    Trailing(
        /// Number of bytes after the last field.
        usize,
    ),
    /// The length of a string or array is impossible.
    #[error("a length of {count} cannot be true with {left} bytes to follow")]
    LengthBeyondEnd {
        /// Declared length.
        count: u64,
        /// Number of bytes after the length.
        left: usize,
    },
    /// A string is not UTF-8.
    #[error("the text is not UTF-8")]
    InvalidUtf8,
    /// A value is of another kind than the field.
    #[error("takes {expected}, got {found}")]
    Mismatch {
        /// Kind of value that the field takes.
        expected: &'static str,
        /// Kind of value that was found.
        found: &'static str,
    },
    /// A number is out of the field's range.
    #[error("{found} does not fit into {expected}")]
    OutOfRange {
        /// Type of the field.
        expected: &'static str,
        /// The number.
        found: String,
    },
    /// The path names a field that the type does not have.
    #[error("there is no such field")]
    NoSuchField,
    /// A fixed array has the wrong number of elements.
    #[error("takes exactly {expected} elements, got {found}")]
    WrongLength {
        /// Length required by the definition.
        expected: usize,
        /// Actual length, or a lower bound if counting stopped there.
        found: usize,
    },
    /// There are more elements or characters than the definition allows.
    #[error("takes at most {most} {of}, got {found}")]
    TooMany {
        /// Bound in the definition.
        most: usize,
        /// Unit of the count.
        of: &'static str,
        /// Actual count, or a lower bound if counting stopped there.
        found: usize,
    },
    /// The representation is not one that ROS 2 nodes use.
    #[error("serialized as representation {0:#06x}, of which only plain CDR is read (0x0000 and 0x0001)")]
    Representation(
        /// First two bytes of the message (DDS-XTypes 1.3, table 60).
        u16,
    ),
    /// Text given for bytes is not base64.
    #[error("the text is not base64")]
    Base64,
    /// The input is not JSON.
    #[error("invalid JSON at byte {at}: {reason}")]
    Json {
        /// Byte offset in the input.
        at: usize,
        /// The token expected, or the problem found.
        reason: &'static str,
    },
    /// The input is not CBOR.
    #[error("invalid CBOR at byte {at}: {reason}")]
    Cbor {
        /// Byte offset in the input.
        at: usize,
        /// The item expected, or the problem found.
        reason: &'static str,
    },
    /// The input is nested too deeply.
    #[error("nested deeper than {0} levels")]
    TooDeep(
        /// Maximum nesting.
        usize,
    ),
    /// The output would exceed the limit.
    #[error("the converted message is larger than the limit of {0} bytes")]
    TooLarge(
        /// Limit in bytes.
        usize,
    ),
}

/// An error that collects its path while it propagates. Boxed, so that results on the hot path stay one word.
#[derive(Debug)]
pub struct Fault(Box<FaultDetails>);

#[derive(Debug)]
struct FaultDetails {
    kind: CodecErrorKind,
    /// Path segments, innermost first.
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
        Fault(Box::new(FaultDetails { kind, place: Vec::new() }))
    }
}

impl Fault {
    pub(crate) fn is_out_of_range(&self) -> bool {
        matches!(self.0.kind, CodecErrorKind::OutOfRange { .. })
    }

    /// Adds the name or path of a field; an empty one is the message itself.
    #[cold]
    pub fn in_field(mut self, path: &str) -> Fault {
        if !path.is_empty() {
            self.0.place.push(Segment::Field(path.to_owned()));
        }
        self
    }

    /// Adds the position in an array.
    #[cold]
    pub fn at_index(mut self, index: usize) -> Fault {
        self.0.place.push(Segment::Index(index));
        self
    }

    /// Returns the error for a message of the type of this name.
    #[cold]
    pub fn into_codec_error(self, type_name: &str) -> CodecError {
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
        CodecError { type_name: type_name.to_owned(), path, kind: self.0.kind }
    }
}

/// Creates the error for a value of the wrong kind.
#[cold]
pub(crate) fn mismatch(expected: &'static str, found: &'static str) -> Fault {
    CodecErrorKind::Mismatch { expected, found }.into()
}
