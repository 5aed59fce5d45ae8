//! Discovery settings of ROS 2 nodes.

use std::net::SocketAddr;

pub use rtps::{DiscoveryServer, InterfaceAddress, InterfaceSelection};

/// Where a node discovers others and is discovered by them (ROS 2). The default is a servant's network, which has
/// nothing but `lo`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DiscoveryNetwork {
    /// Interfaces on which it takes part.
    pub interfaces: InterfaceSelection,
    /// True to discover others by multicast; nodes on the same machine are found without it.
    pub multicast: bool,
    /// True to discover no other node and to stay hidden from all.
    pub alone: bool,
    /// Additional peers to announce the node to: their discovery ports, or all nodes of a host if the port is 0.
    pub peers: Vec<SocketAddr>,
    /// Fast DDS discovery servers; if there are any, nodes are discovered through them only.
    pub servers: Vec<DiscoveryServer>,
    /// True to use the well-known ports, which others try without having been told of them.
    pub well_known: bool,
}

impl Default for DiscoveryNetwork {
    fn default() -> Self {
        Self {
            interfaces: InterfaceSelection::default(),
            multicast: true,
            alone: false,
            peers: Vec::new(),
            servers: Vec::new(),
            well_known: false,
        }
    }
}
