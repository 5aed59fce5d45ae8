//! Errors in the text of a definition.

use crate::schema::IdlError;
use crate::schema::limits::{MAX_MESSAGE_BYTES, MAX_NAME_BYTES};

/// A syntax error in a definition. The texts quote it as it is written there.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SyntaxError {
    /// A name is not a letter followed by letters, digits and underscores.
    #[error("{0:?} is not a legal name")]
    BadIdentifier(String),
    /// A name is too long to be quoted.
    #[error("a name is longer than {MAX_NAME_BYTES} bytes")]
    LongName,
    /// The type of a field has too many parts, or a kind that does not exist.
    #[error("{0:?} is not a type name, write package/Type")]
    BadTypeName(String),
    /// A line is not a field.
    #[error("{0:?} is not a field, write TYPE NAME")]
    NotAField(String),
    /// Two fields have this name.
    #[error("field {0} is there twice")]
    RepeatedField(String),
    /// The brackets behind a type are not closed.
    #[error("{0} is not an array suffix")]
    BadArraySuffix(String),
    /// The length of an array is no number (ROS 1).
    #[error("array length {0} is not a number up to {MAX_MESSAGE_BYTES}")]
    BadArrayLength(String),
    /// The length or bound of an array or text is no number (ROS 2).
    #[error("a size of {0} is not a number from 1 to {MAX_MESSAGE_BYTES}")]
    BadSize(String),
    /// A bound follows a type that takes none.
    #[error("{0} cannot be bounded")]
    Unboundable(String),
    /// A ROS 2 definition uses `time` or `duration` of ROS 1.
    #[error("ROS 2 has no {written}, write builtin_interfaces/{message}")]
    TypeOfRos1 {
        /// The type as written.
        written: String,
        /// Name of the message in its place.
        message: &'static str,
    },
    /// Constants cannot have this type.
    #[error("a constant cannot be of type {0}")]
    BadConstantType(String),
    /// The value does not belong to its type.
    #[error("{value:?} is no {type_name}")]
    BadValue {
        /// The value as written.
        value: String,
        /// Name of the type.
        type_name: String,
    },
    /// A field that is a message has a default value.
    #[error("a field of type {type_name} takes no value, got {value:?}")]
    NoValueAllowed {
        /// Name of the type.
        type_name: String,
        /// The value as written.
        value: String,
    },
    /// The value of an array is not in brackets.
    #[error("{0} is not a list, write [VALUE, VALUE]")]
    NotAList(String),
    /// A quoted text does not end.
    #[error("{0} has no closing quote")]
    UnclosedQuote(String),
    /// Two values of a list have no comma between them.
    #[error("{0:?} follows a value, write a comma")]
    MissingComma(String),
    /// A quoted text is not the last of its line.
    #[error("{0:?} follows the closing quote")]
    TextAfterQuote(String),
    /// The default value of an array has another length than the array.
    #[error("takes exactly {expected} values, got {found}")]
    WrongValueCount {
        /// Length of the array.
        expected: u32,
        /// Number of values.
        found: usize,
    },
    /// The default value of an array exceeds its bound.
    #[error("takes at most {most} values, got {found}")]
    TooManyValues {
        /// The bound.
        most: u32,
        /// Number of values.
        found: usize,
    },
    /// The default value of a text exceeds its bound.
    #[error("takes at most {most} characters, got {found}")]
    TooManyCharacters {
        /// The bound.
        most: u32,
        /// Number of characters.
        found: usize,
    },
    /// A value from IDL or a description has a line break, which a line of a definition cannot hold.
    #[error("the value of {0} goes over a line")]
    ValueOverLine(
        /// Name of the field.
        String,
    ),
    /// The IDL has an error of its own.
    #[error(transparent)]
    Idl(#[from] IdlError),
    /// The JSON is not a description of a type. The reason is in the JSON parser's words: its error can be neither
    /// cloned nor compared.
    #[error("not a description of a type: {0}")]
    NotADescription(String),
    /// A description has a field of a type that messages do not have.
    #[error("field {field} is of type {type_id}, which messages do not have")]
    BadTypeId {
        /// Name of the field.
        field: String,
        /// Number of the type.
        type_id: u8,
    },
    /// One of the types in a description has an error.
    #[error("{type_name}: {reason}")]
    InType {
        /// Name of the type.
        type_name: String,
        /// The problem.
        reason: Box<SyntaxError>,
    },
}
