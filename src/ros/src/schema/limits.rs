//! How large a definition may be. Definitions are untrusted (a publisher's connection header, a pushed
//! package), and a few bytes of text can ask for a message of gigabytes.

/// Longest text of one definition, and of one concatenated definition from a publisher's header.
pub const MAX_TEXT_BYTES: usize = 1 << 20;

/// Most fields in one message.
pub const MAX_FIELDS: usize = 4096;

/// Deepest nesting of messages in messages.
pub const MAX_DEPTH: usize = 64;

/// Largest message that fixed arrays alone may demand.
pub const MAX_MESSAGE_BYTES: usize = 64 << 20;

/// Most values that an otherwise empty message may hold (fixed arrays of messages count each element).
pub(crate) const MAX_VALUES: usize = 1 << 22;

/// Longest name of a package, a type or a field.
pub(crate) const MAX_NAME_BYTES: usize = 255;

/// Most definitions in one full text.
pub(crate) const MAX_DEFINITIONS: usize = 512;
