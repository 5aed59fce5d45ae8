//! Translators of serialized messages.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use ros_message::RosVersion;
use ros_message::codec::cursor::MessageCursor;
use ros_message::codec::{CodecErrorKind, Fault};
use ros_message::schema::MessageType;

use crate::TranslationError;
use crate::output::Output;
use crate::program::{Program, Run};

/// Bytes that any message may take: elements of an array may have long fields that only the twin has.
const LITTLE: usize = 64 << 10;

/// Translates serialized messages of one type into those of its twin. Share it by `Arc`.
#[derive(Debug)]
pub struct MessageTranslator {
    source: Arc<MessageType>,
    program: Arc<Program>,
    /// Bytes that the smallest message of the twin may take.
    least: usize,
    /// Bytes that the program and those of the messages in it take.
    bytes: usize,
    saturated: AtomicU64,
}

impl MessageTranslator {
    /// Creates a translator by a program that takes this number of bytes, with those that it calls.
    pub(crate) fn new(
        source: Arc<MessageType>,
        target: &MessageType,
        program: Arc<Program>,
        bytes: usize,
    ) -> MessageTranslator {
        // Padding takes less than the numbers behind it.
        let least = target.min_size().saturating_mul(2).saturating_add(program.filled).saturating_add(LITTLE);
        MessageTranslator { source, program, least, bytes, saturated: AtomicU64::new(0) }
    }

    /// Returns about how many bytes its programs take.
    pub(crate) fn bytes_held(&self) -> usize {
        self.bytes
    }

    /// Returns the message in the twin's serialization.
    ///
    /// The bytes may be anything: those that are no message of the type are refused, with the field in the error, as is
    /// a message that exceeds a bound of the twin's definition. The result takes at most a fixed multiple of `bytes`,
    /// beside what the twin's definition always takes.
    pub fn translate(&self, bytes: &[u8]) -> Result<Bytes, TranslationError> {
        self.run(bytes).map_err(|fault| fault.into_codec_error(self.source.name()))
    }

    /// Returns the number of values so far that the twin could not hold and in whose place the nearest ones were
    /// written: times before 1970 or after 2038, numbers out of range, characters that are not Unicode.
    pub fn saturated_count(&self) -> u64 {
        self.saturated.load(Ordering::Relaxed)
    }

    fn run(&self, bytes: &[u8]) -> Result<Bytes, Fault> {
        let from = self.source.version();
        let cursor = MessageCursor::new(from, bytes).ok_or_else(|| unreadable(bytes))?;
        let out = Output::new(from.other(), bytes.len(), self.least);
        let mut run = Run { from, cursor, out, places: Vec::new(), saturated: 0 };
        run.program(&self.program)?;
        // In ROS 2 bytes may follow: some senders serialize into a buffer of estimated size.
        let trailing = run.cursor.remaining();
        if from == RosVersion::One && trailing > 0 {
            return Err(CodecErrorKind::Trailing(trailing).into());
        }
        if run.saturated > 0 {
            self.saturated.fetch_add(run.saturated, Ordering::Relaxed);
        }
        Ok(run.out.finish().into())
    }
}

/// Returns the error for bytes that do not begin as a message of ROS 2.
fn unreadable(bytes: &[u8]) -> CodecErrorKind {
    match bytes {
        [first, second, _, _, ..] => CodecErrorKind::Representation(u16::from_be_bytes([*first, *second])),
        _ => CodecErrorKind::Truncated { missing: 4 - bytes.len() },
    }
}
