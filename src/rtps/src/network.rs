//! Under which addresses this machine is reached, and under which of theirs others are.
//!
//! A robot has several networks, and some come after boot (Wi-Fi). Whoever is on this machine is reached at its loopback address,
//! whoever is not under that of its addresses from which it was heard, or one in a network that both have. Bridges of containers
//! have the same address on many machines: one of ours among another machine's addresses does not lead there.

#![forbid(unsafe_code)]

use std::collections::BTreeSet;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use nix::ifaddrs::getifaddrs;
use nix::net::if_::InterfaceFlags;

use crate::locator::Locator;

/// Which of a place's addresses a participant uses.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Interfaces {
    /// Those that the place has, also those that come later.
    All,
    /// These, as far and as soon as the place has them. `127.0.0.1` alone where nobody is outside.
    These(Vec<Ipv4Addr>),
}

impl Default for Interfaces {
    /// This machine alone.
    fn default() -> Self {
        Self::These(vec![Ipv4Addr::LOCALHOST])
    }
}

/// An interface of a place, by one of its addresses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Interface {
    /// The address.
    pub address: Ipv4Addr,
    /// How many of its first bits all addresses of its network have: 0 to 32.
    pub prefix: u8,
}

impl Interface {
    /// The loopback device.
    pub const LOOPBACK: Self = Self {
        address: Ipv4Addr::LOCALHOST,
        prefix: 8,
    };

    fn shares(&self, other: Ipv4Addr) -> bool {
        let mask = u32::MAX
            .checked_shl(32 - u32::from(self.prefix.min(32)))
            .unwrap_or(0);
        self.prefix != 0 && (self.address.to_bits() ^ other.to_bits()) & mask == 0
    }
}

/// The interfaces that are up in the network namespace of the calling thread, with their IPv4 addresses.
///
/// # Errors
/// The kernel does not tell.
pub fn interfaces() -> io::Result<Vec<Interface>> {
    let mut found = BTreeSet::new();
    for interface in getifaddrs()? {
        let address = interface
            .address
            .as_ref()
            .and_then(|it| it.as_sockaddr_in());
        let Some(address) = address.filter(|_| interface.flags.contains(InterfaceFlags::IFF_UP))
        else {
            continue;
        };
        let mask = interface
            .netmask
            .as_ref()
            .and_then(|it| it.as_sockaddr_in());
        // A connection of two has no network beside its peer.
        let prefix = mask.map_or(32, |mask| mask.ip().to_bits().leading_ones());
        found.insert(Interface {
            address: address.ip(),
            prefix: prefix as u8,
        });
    }
    Ok(found.into_iter().collect())
}

impl Interfaces {
    /// Whether nothing but this machine is meant: then nothing comes or goes.
    pub(crate) fn is_loopback(&self) -> bool {
        matches!(self, Self::These(these) if these.iter().all(Ipv4Addr::is_loopback))
    }

    /// Those among them that are meant.
    pub(crate) fn among(&self, mut found: Vec<Interface>) -> Vec<Interface> {
        if let Self::These(these) = self {
            found.retain(|interface| these.contains(&interface.address));
        }
        found
    }
}

/// The interfaces of a participant, as it knows them now.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Network {
    interfaces: Vec<Interface>,
}

impl Network {
    /// With these; with the loopback device where there is none.
    pub fn new(mut interfaces: Vec<Interface>) -> Self {
        if interfaces.is_empty() {
            interfaces.push(Interface::LOOPBACK);
        }
        Self { interfaces }
    }

    pub fn addresses(&self) -> impl Iterator<Item = Ipv4Addr> {
        self.interfaces.iter().map(|interface| interface.address)
    }

    /// Where others reach a port of this machine. The loopback address is told only where there is no other: sent to another
    /// machine, it would mean that one.
    pub fn locators(&self, port: u16) -> Vec<Locator> {
        let outside: Vec<Ipv4Addr> = self.addresses().filter(|ip| !ip.is_loopback()).collect();
        let told = match outside.is_empty() {
            true => vec![Ipv4Addr::LOCALHOST],
            false => outside,
        };
        told.into_iter()
            .map(|ip| Locator::from((ip, port)))
            .collect()
    }

    /// Whether an address is this machine's.
    pub fn is_here(&self, ip: IpAddr) -> bool {
        match ip {
            IpAddr::V4(ip) => ip.is_loopback() || self.addresses().any(|own| own == ip),
            IpAddr::V6(ip) => ip.is_loopback(),
        }
    }

    /// Whether an address is this machine's, or in one of its networks.
    pub fn leads_to(&self, ip: IpAddr) -> bool {
        let near = match ip {
            IpAddr::V4(ip) => self.interfaces.iter().any(|it| it.shares(ip)),
            IpAddr::V6(_) => false,
        };
        near || self.is_here(ip)
    }

    /// Where to send to whoever tells these locators; `heard` is the address from which it was heard, where that is known. None
    /// where none of them leads to it.
    pub fn choose(&self, locators: &[Locator], heard: Option<IpAddr>) -> Option<SocketAddr> {
        let udp = locators.iter().filter_map(Locator::udp);
        let told: Vec<SocketAddr> = udp.filter(|it| !it.ip().is_multicast()).collect();
        let all_here = told.iter().all(|address| self.is_here(address.ip()));
        let is_here = match heard {
            Some(ip) => self.is_here(ip),
            None => all_here,
        };
        if is_here {
            let loopback = told.iter().find(|address| address.ip().is_loopback());
            let own = || told.iter().find(|address| self.is_here(address.ip()));
            return loopback.or_else(own).or_else(|| told.first()).copied();
        }
        let outside = told
            .into_iter()
            .filter(|address| !address.ip().is_loopback());
        outside.min_by_key(|address| {
            if Some(address.ip()) == heard {
                return 0;
            }
            match address.ip() {
                ip if self.is_here(ip) => 3,
                IpAddr::V4(ip) if self.interfaces.iter().any(|it| it.shares(ip)) => 1,
                _ => 2,
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ip(text: &str) -> Ipv4Addr {
        text.parse().expect("an address")
    }

    fn network(interfaces: &[(&str, u8)]) -> Network {
        let of = |(address, prefix): &(&str, u8)| Interface {
            address: ip(address),
            prefix: *prefix,
        };
        Network::new(interfaces.iter().map(of).collect())
    }

    fn chosen(network: &Network, told: &[&str], heard: Option<&str>) -> Option<String> {
        let told: Vec<Locator> = told
            .iter()
            .map(|it| Locator::from((ip(it), 7410)))
            .collect();
        let chosen = network.choose(&told, heard.map(|heard| ip(heard).into()));
        chosen.map(|address| address.ip().to_string())
    }

    #[test]
    fn whoever_is_elsewhere_is_reached_where_it_was_heard_or_where_both_are() {
        let robot = network(&[
            ("127.0.0.1", 8),
            ("10.0.0.5", 24),
            ("192.168.1.5", 24),
            ("172.17.0.1", 16),
        ]);
        let told = ["172.17.0.1", "10.0.9.7", "192.168.1.7", "10.0.0.7"];
        let to = |heard| chosen(&robot, &told, heard);
        assert_eq!(to(Some("10.0.0.7")).as_deref(), Some("10.0.0.7"));
        assert_eq!(to(Some("10.0.9.7")).as_deref(), Some("10.0.9.7"));
        // By a relay, or through a translation of addresses: one in a network that both have.
        assert_eq!(to(None).as_deref(), Some("192.168.1.7"));
        assert_eq!(to(Some("10.0.0.77")).as_deref(), Some("192.168.1.7"));
        // None that both have: any of the other's.
        let far = chosen(&robot, &["172.17.0.1", "10.9.9.9"], Some("10.0.0.1"));
        assert_eq!(far.as_deref(), Some("10.9.9.9"));
        // Loopback there is not loopback here.
        assert_eq!(chosen(&robot, &["127.0.0.1"], Some("10.0.0.7")), None);
        let both = chosen(&robot, &["127.0.0.1", "10.0.0.7"], Some("10.0.0.7"));
        assert_eq!(both.as_deref(), Some("10.0.0.7"));
    }

    #[test]
    fn whoever_is_on_this_machine_is_reached_without_its_networks() {
        let robot = network(&[("127.0.0.1", 8), ("10.0.0.5", 24)]);
        let to = |told: &[&str], heard| chosen(&robot, told, heard);
        for heard in [None, Some("127.0.0.1"), Some("10.0.0.5")] {
            let both = to(&["10.0.0.5", "127.0.0.1"], heard);
            assert_eq!(both.as_deref(), Some("127.0.0.1"));
            assert_eq!(to(&["10.0.0.5"], heard).as_deref(), Some("10.0.0.5"));
            assert_eq!(to(&["127.0.0.1"], heard).as_deref(), Some("127.0.0.1"));
        }
    }

    #[test]
    fn others_are_told_of_loopback_only_where_there_is_nothing_else() {
        let told = |network: Network| -> Vec<String> {
            let locators = network.locators(7411);
            let udp = locators.iter().filter_map(Locator::udp);
            udp.map(|address| address.to_string()).collect()
        };
        let robot = network(&[("127.0.0.1", 8), ("10.0.0.5", 24), ("10.1.0.5", 24)]);
        assert_eq!(told(robot), ["10.0.0.5:7411", "10.1.0.5:7411"]);
        assert_eq!(told(network(&[("127.0.0.1", 8)])), ["127.0.0.1:7411"]);
        assert_eq!(told(network(&[])), ["127.0.0.1:7411"]);
    }

    #[test]
    fn this_machine_has_a_loopback_device() {
        let found = interfaces().expect("interfaces");
        assert!(found.contains(&Interface::LOOPBACK), "{found:?}");
        let these = Interfaces::default();
        assert_eq!(these.among(found), [Interface::LOOPBACK]);
        assert!(these.is_loopback() && !Interfaces::All.is_loopback());
    }

    #[test]
    fn a_network_of_one_address_shares_it_with_nobody() {
        let one = Interface {
            address: ip("10.0.0.5"),
            prefix: 32,
        };
        assert!(one.shares(ip("10.0.0.5")) && !one.shares(ip("10.0.0.4")));
        let all = Interface { prefix: 0, ..one };
        assert!(!all.shares(ip("10.0.0.4")));
    }
}
