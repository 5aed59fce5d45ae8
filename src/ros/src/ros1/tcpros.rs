//! TCPROS (<http://wiki.ros.org/ROS/TCPROS>): connection headers, then length-prefixed messages, or calls.

mod frames;
mod header;
mod send_queue;
mod service;

use std::io;
use std::time::Duration;

pub(crate) use frames::BIG;
pub use frames::{FrameBounds, FrameReader};
pub use header::{Header, MAX_HEADER};
pub use send_queue::{SendQueue, write_messages};
pub use service::{CallError, ServiceConnection, serve_calls};

pub use crate::join::{MAX_MESSAGE, UNFINISHED};

/// A TCPROS connection that broke.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The connection failed, or ended inside a message.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// What should be a connection header is none.
    #[error("bad connection header: {0}")]
    Header(String),
    /// A message longer than we take.
    #[error("a message of {size} bytes announced; the limit is {max}")]
    TooLarge {
        /// What its prefix says.
        size: usize,
        /// Most bytes that are accepted.
        max: usize,
    },
    /// A message that does not fit into the memory for its servant.
    #[error("a message cannot be read: {0}")]
    Exceeded(#[from] budget::Exceeded),
    /// A message that was begun and never completed.
    #[error("a message of {size} bytes is not complete after {after:?}; {read} of them came")]
    Unfinished {
        /// What its prefix says.
        size: usize,
        /// Bytes of the message that came.
        read: usize,
        /// How long was waited.
        after: Duration,
    },
    /// The peer answered the header with an error.
    #[error("the peer refused: {0}")]
    Refused(String),
}
