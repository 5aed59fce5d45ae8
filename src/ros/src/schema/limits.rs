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
