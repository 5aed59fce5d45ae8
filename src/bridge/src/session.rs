//! Sessions of a bridge as its owner sees them.

/// Number of sessions of a bridge.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SessionCount {
    /// Sessions that are connected.
    pub connected: usize,
    /// Sessions that are disconnected, but still within their grace period.
    pub away: usize,
}

/// The end of a connection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SessionEnd {
    /// The client closed it.
    Client {
        /// WebSocket close code; 1005 if the client gave none.
        code: u16,
        /// Close reason given by the client.
        reason: String,
    },
    /// The bridge closed it.
    Closed {
        /// WebSocket close code.
        code: u16,
        /// Close reason sent to the client.
        reason: String,
    },
    /// The socket failed or ended without a close frame.
    Lost(String),
}
