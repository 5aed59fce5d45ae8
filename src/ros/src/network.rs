//! Where nodes of ROS 2 look for each other.

use std::net::SocketAddr;

pub use rtps::{DiscoveryServer, Interface, Interfaces};

/// Where a node looks for others, and is found by them (ROS 2). By default it is in a servant's network, which has nothing but `lo`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Network {
    /// In which networks it takes part.
    pub interfaces: Interfaces,
    /// Whether others are looked for by multicast; those of this machine are found without it.
    pub multicast: bool,
    /// Whether it looks for nobody and is found by nobody.
    pub alone: bool,
    /// Others that are told of it beside: their ports for discovery, or all those of a host's nodes where the port is 0.
    pub peers: Vec<SocketAddr>,
    /// Servers of discovery of Fast DDS: where there are some, others are looked for by them alone.
    pub servers: Vec<DiscoveryServer>,
    /// Whether it has ports that others try without having been told of them.
    pub well_known: bool,
}

impl Default for Network {
    fn default() -> Self {
        Self {
            interfaces: Interfaces::default(),
            multicast: true,
            alone: false,
            peers: Vec::new(),
            servers: Vec::new(),
            well_known: false,
        }
    }
}
