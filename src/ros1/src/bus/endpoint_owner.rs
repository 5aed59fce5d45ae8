//! Owners of endpoints.

/// Owner of an endpoint of a topic. Messages published by this node are not delivered to its own subscriptions, except
/// where one of the two endpoints belongs to an action: an action's topics may also be used directly, and its client
/// may have its server behind the same bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum EndpointOwner {
    /// The owner of the bus.
    User,
    /// An action of this node.
    Action,
}
