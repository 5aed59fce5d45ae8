//! Interfaces of a machine, and the discovery settings of ROS 2 nodes.

use std::collections::BTreeSet;
use std::io;
use std::net::{Ipv4Addr, SocketAddr};

use nix::ifaddrs::getifaddrs;
use nix::net::if_::InterfaceFlags;

/// An address of a network interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct InterfaceAddress {
    /// IPv4 address.
    pub address: Ipv4Addr,
    /// Prefix length of its network: 0 to 32.
    pub prefix: u8,
}

impl InterfaceAddress {
    /// The loopback device.
    pub const LOOPBACK: Self = Self { address: Ipv4Addr::LOCALHOST, prefix: 8 };
}

/// Returns the IPv4 addresses of the interfaces that are up in the network namespace of the calling thread.
///
/// # Errors
/// The kernel does not answer.
pub fn list_interfaces() -> io::Result<Vec<InterfaceAddress>> {
    let mut found = BTreeSet::new();
    for interface in getifaddrs()? {
        let address = interface.address.as_ref().and_then(|it| it.as_sockaddr_in());
        let Some(address) = address.filter(|_| interface.flags.contains(InterfaceFlags::IFF_UP)) else {
            continue;
        };
        let mask = interface.netmask.as_ref().and_then(|it| it.as_sockaddr_in());
        // A point-to-point link has no network besides its peer.
        let prefix = mask.map_or(32, |mask| mask.ip().to_bits().leading_ones());
        found.insert(InterfaceAddress { address: address.ip(), prefix: prefix as u8 });
    }
    Ok(found.into_iter().collect())
}

/// Selects the interfaces on which a node discovers others.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum InterfaceSelection {
    /// All interfaces, including those that appear later.
    All,
    /// Interfaces with these addresses, as soon as they exist. Only `127.0.0.1` if nobody outside is to be reached.
    These(Vec<Ipv4Addr>),
}

impl Default for InterfaceSelection {
    /// Returns the selection of the loopback device only.
    fn default() -> Self {
        Self::These(vec![Ipv4Addr::LOCALHOST])
    }
}

/// A Fast DDS discovery server, as clients are configured with it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DiscoveryServer {
    /// Position in the list of servers, with which the server itself is configured; it determines its name.
    pub place: u8,
    /// Address at which it receives discovery data.
    pub at: SocketAddr,
}

/// Network in which a node and others discover each other (ROS 2). The default is a servant's network, which has
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn this_machine_has_a_loopback_device() {
        let found = list_interfaces().expect("interfaces");
        assert!(found.contains(&InterfaceAddress::LOOPBACK), "{found:?}");
    }
}
