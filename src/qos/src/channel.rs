//! The channels of a node that messages of requests go through.

use std::sync::Arc;

/// Where a message goes to or came from.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Channel {
    /// A service or an action, by absolute name.
    Call(Arc<str>),
    /// A topic, by absolute name.
    Topic(Arc<str>),
}
