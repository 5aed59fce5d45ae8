//! How a servant is reached.

use std::sync::Arc;

/// What an engine gives for a running servant. One kind now; a cluster engine will add an address to dial.
#[derive(Debug, Clone)]
pub struct Endpoint {
    /// The network namespace to open sockets in.
    pub netns: Arc<crate::netns::NetNs>,
}
