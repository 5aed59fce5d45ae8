//! The channels of a node on which requests and answers travel.

use std::sync::Arc;

/// The channel a message was sent to or received from.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum RequestChannel {
    /// Absolute name of a service or an action.
    Call(Arc<str>),
    /// Absolute name of a topic.
    Topic(Arc<str>),
}

impl RequestChannel {
    /// Returns the absolute name.
    pub fn name(&self) -> &Arc<str> {
        let (Self::Call(name) | Self::Topic(name)) = self;
        name
    }
}
