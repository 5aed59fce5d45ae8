//! TCPROS (<http://wiki.ros.org/ROS/TCPROS>): connection headers, then length-prefixed messages, or calls.

mod frames;
mod header;
mod outbox;
mod service;

use std::io;

pub(crate) use frames::BIG;
pub use frames::FrameReader;
pub use header::{Header, MAX_HEADER};
pub use outbox::{Outbox, write_messages};
pub use service::{CallError, ServiceConnection, serve_calls};

/// A message longer than this ends its connection, unless set otherwise.
pub const MAX_MESSAGE: usize = 256 << 20;

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
        /// The limit.
        max: usize,
    },
    /// The peer answered the header with an error.
    #[error("the peer refused: {0}")]
    Refused(String),
}
