//! MCAP files (<https://mcap.dev/spec>) of ROS 1 or ROS 2 messages in their original encoding.

#![deny(unsafe_code)]

mod format;
mod reader;
mod writer;

use std::io;
use std::path::PathBuf;

use mcap::McapError;

pub use format::RecordingFormat;
pub use reader::{RecordedMessage, RecordingReader};
pub use writer::{RecordingWriter, Summary, TopicSummary};

/// Reason why a file cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file cannot be created, for example because it exists.
    #[error("cannot create {}: {reason}", path.display())]
    NotMade {
        /// Path of the file.
        path: PathBuf,
        /// Underlying error.
        reason: io::Error,
    },
    /// Writing failed; what was written before remains readable.
    #[error("{} cannot be completed: {reason}; what was written so far can be read", path.display())]
    Unwritable {
        /// Path of the file.
        path: PathBuf,
        /// Underlying error.
        reason: McapError,
    },
    /// The file cannot be opened or read.
    #[error("{} cannot be read: {reason}", path.display())]
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// Underlying error.
        reason: io::Error,
    },
    /// The file is not an MCAP file.
    #[error("{} is not an MCAP file", path.display())]
    NoRecording {
        /// Path of the file.
        path: PathBuf,
    },
    /// The file is corrupt.
    #[error("{} cannot be read any further: {reason}", path.display())]
    Broken {
        /// Path of the file.
        path: PathBuf,
        /// Description of the damage.
        reason: String,
    },
}
