//! MCAP files (<https://mcap.dev/spec>) of messages of ROS 1 or of ROS 2, as the bytes that they are.

#![deny(unsafe_code)]

mod format;
mod reader;
mod writer;

use std::io;
use std::path::PathBuf;

use mcap::McapError;

pub use format::Format;
pub use reader::{Played, Reader};
pub use writer::{Summary, TopicSummary, Writer};

/// Why a file cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// It cannot be made, as where there is one of this name.
    #[error("{} cannot be made: {reason}", path.display())]
    NotMade {
        /// Where.
        path: PathBuf,
        /// Why.
        reason: io::Error,
    },
    /// What was written by then stays.
    #[error("{} cannot be written to its end: {reason}; what it holds by now can be read", path.display())]
    Unwritable {
        /// Where.
        path: PathBuf,
        /// Why.
        reason: McapError,
    },
    /// It cannot be opened or read.
    #[error("{} cannot be read: {reason}", path.display())]
    Unreadable {
        /// Where.
        path: PathBuf,
        /// Why.
        reason: io::Error,
    },
    /// It is something else.
    #[error("{} is no MCAP file", path.display())]
    NoRecording {
        /// Where.
        path: PathBuf,
    },
    /// It is broken somewhere.
    #[error("{} cannot be read on: {reason}", path.display())]
    Broken {
        /// Where.
        path: PathBuf,
        /// How.
        reason: String,
    },
}
