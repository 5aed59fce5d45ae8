//! Errors in IDL.

use crate::schema::limits::{MAX_TEXT_BYTES, MOST_MODULES};

/// An error in an IDL file. Tokens are quoted as they are written there.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum IdlError {
    /// The text ends before the brace that closes a module.
    #[error("the text ends inside a module")]
    UnclosedModule,
    /// A comment does not end.
    #[error("a comment without an end")]
    UnclosedComment,
    /// A quoted text does not end.
    #[error("a text without a closing quote")]
    UnclosedText,
    /// Modules nest too deep.
    #[error("modules nest deeper than {MOST_MODULES}")]
    DeepModules,
    /// A type is in more modules than can nest.
    #[error("{0} is in more than {MOST_MODULES} modules")]
    DeepType(
        /// The first part of the type.
        String,
    ),
    /// A definition is of a kind that messages do not have.
    #[error("{0} does not begin a definition that messages can have")]
    NotADefinition(String),
    /// Messages have no such type.
    #[error("messages have no {0}")]
    NotInMessages(String),
    /// `unsigned` is followed by no integer type.
    #[error("unsigned {0} is not a type")]
    NotUnsigned(String),
    /// The name has brackets, and so has its type.
    #[error("{0} is an array of arrays")]
    ArrayOfArrays(String),
    /// The structures take more bytes as text than a definition may have.
    #[error("it defines more than {MAX_TEXT_BYTES} bytes")]
    TooMuchText,
    /// A token is not the punctuation mark that must be there.
    #[error("expected {expected}, got {found}")]
    MissingMark {
        /// The mark.
        expected: char,
        /// The token found.
        found: String,
    },
    /// A token is not a name.
    #[error("expected a name, got {0}")]
    NotAName(String),
    /// A token is not a value.
    #[error("{0} is not a value")]
    NotAValue(String),
}
