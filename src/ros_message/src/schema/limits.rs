//! Limits of definitions. Definitions are untrusted (a publisher's connection header, a pushed package), and a few
//! bytes of text can ask for a message of gigabytes.

/// Maximum length of the text of one definition, and of a full text from a publisher's header.
pub const MAX_TEXT_BYTES: usize = 1 << 20;

/// Maximum number of fields in a message.
pub const MAX_FIELDS: usize = 4096;

/// Maximum nesting of messages.
pub const MAX_DEPTH: usize = 64;

/// Maximum size of a message due to fixed arrays alone.
pub const MAX_MESSAGE_BYTES: usize = 64 << 20;

/// Maximum number of values in an otherwise empty message (each element of a fixed array of messages counts).
pub(crate) const MAX_VALUES: usize = 1 << 22;

/// Maximum length of the name of a package, a type or a field.
pub(crate) const MAX_NAME_BYTES: usize = 255;

/// Maximum number of definitions in one full text.
pub(crate) const MAX_DEFINITIONS: usize = 512;

/// Maximum nesting of modules in IDL: package, kind, and the module of a structure's constants.
pub(crate) const MOST_MODULES: usize = 3;

/// A limit that a definition exceeds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum ExceededLimit {
    /// The definition, or the full text with it, has more than [`MAX_TEXT_BYTES`].
    #[error("more than {MAX_TEXT_BYTES} bytes of text")]
    TextBytes,
    /// The description of the type has more than [`MAX_TEXT_BYTES`].
    #[error("more than {MAX_TEXT_BYTES} bytes of description")]
    DescriptionBytes,
    /// The IDL has more than [`MAX_TEXT_BYTES`].
    #[error("more than {MAX_TEXT_BYTES} bytes of IDL")]
    IdlBytes,
    /// The full text has more definitions than are read from one.
    #[error("its text holds more than {MAX_DEFINITIONS} definitions")]
    Definitions,
    /// The message has more than [`MAX_FIELDS`], constants included.
    #[error("more than {MAX_FIELDS} fields and constants")]
    Fields,
    /// Messages nest deeper than [`MAX_DEPTH`].
    #[error("messages nest deeper than {MAX_DEPTH}")]
    Depth,
    /// The message takes more than [`MAX_MESSAGE_BYTES`] even when it is empty.
    #[error("its fixed arrays take more than {MAX_MESSAGE_BYTES} bytes")]
    FixedArrays,
    /// The message has more values even when it is empty than are decoded.
    #[error("it always holds more than {MAX_VALUES} values")]
    Values,
}
