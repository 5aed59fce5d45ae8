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

impl Channel {
    /// The absolute name.
    pub fn name(&self) -> &Arc<str> {
        let (Self::Call(name) | Self::Topic(name)) = self;
        name
    }
}
