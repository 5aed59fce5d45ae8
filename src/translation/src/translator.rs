//! Translators of serialized messages.

use bytes::Bytes;

use crate::TranslationError;

/// Translates serialized messages of one type into those of its twin. Share it by `Arc`.
#[derive(Debug)]
pub struct MessageTranslator {}

impl MessageTranslator {
    /// Returns the message in the twin's serialization. The result takes at most a fixed multiple of the bytes given
    /// (and of the smallest message of the twin).
    pub fn translate(&self, bytes: &[u8]) -> Result<Bytes, TranslationError> {
        let _ = bytes;
        todo!()
    }

    /// Returns the number of values so far that the twin could not represent and that were replaced by the nearest
    /// ones: times before 1970 or after 2038, numbers out of range, characters that are not Unicode.
    pub fn saturated(&self) -> u64 {
        todo!()
    }
}
