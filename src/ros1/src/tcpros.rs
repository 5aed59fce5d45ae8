//! TCPROS (<http://wiki.ros.org/ROS/TCPROS>): connection headers, then length-prefixed messages or calls.

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

pub use ros_bus::{MAX_MESSAGE, MESSAGE_TIMEOUT};

/// Error of a TCPROS connection.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The connection failed, or ended inside a message.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The connection header is invalid.
    #[error("bad connection header: {0}")]
    Header(String),
    /// A message exceeds the size limit.
    #[error("a message of {size} bytes announced; the limit is {max}")]
    TooLarge {
        /// Size in the length prefix.
        size: usize,
        /// Maximum size in bytes.
        max: usize,
    },
    /// A message does not fit into the servant's memory budget.
    #[error("a message cannot be read: {0}")]
    Exceeded(#[from] budget::Exceeded),
    /// A message was begun and never completed.
    #[error("a message of {size} bytes is not complete after {after:?}; {read} of them came")]
    Unfinished {
        /// Size in the length prefix.
        size: usize,
        /// Bytes of the message received.
        read: usize,
        /// Time waited.
        after: Duration,
    },
    /// The peer answered the header with an error.
    #[error("the peer refused: {0}")]
    Refused(String),
}
