//! Selection of the addresses at which this machine and other participants are reached.
//!
//! A robot has several networks, some of which appear after boot (Wi-Fi). A participant on this machine is reached at
//! its loopback address; another one at that of its addresses from which it was heard, or at one in a common network.
//! Container bridges have the same address on many machines, so one of our own addresses among those of another machine
//! does not lead there.

#![forbid(unsafe_code)]

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use crate::locator::Locator;

/// Selects the interfaces that a participant uses.
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

    fn contains(&self, other: Ipv4Addr) -> bool {
        let mask = u32::MAX.checked_shl(32 - u32::from(self.prefix.min(32))).unwrap_or(0);
        self.prefix != 0 && (self.address.to_bits() ^ other.to_bits()) & mask == 0
    }
}

impl InterfaceSelection {
    /// Returns whether only this machine is selected, in which case the interfaces never change.
    pub(crate) fn is_loopback(&self) -> bool {
        matches!(self, Self::These(these) if these.iter().all(Ipv4Addr::is_loopback))
    }

    /// Returns the selected ones among these.
    pub(crate) fn filter(&self, mut found: Vec<InterfaceAddress>) -> Vec<InterfaceAddress> {
        if let Self::These(these) = self {
            found.retain(|interface| these.contains(&interface.address));
        }
        found
    }
}

/// The interfaces that a participant currently uses.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct InterfaceSet {
    interfaces: Vec<InterfaceAddress>,
}

impl InterfaceSet {
    /// Creates the set; if empty, it contains the loopback device.
    pub fn new(mut interfaces: Vec<InterfaceAddress>) -> Self {
        if interfaces.is_empty() {
            interfaces.push(InterfaceAddress::LOOPBACK);
        }
        Self { interfaces }
    }

    pub fn addresses(&self) -> impl Iterator<Item = Ipv4Addr> {
        self.interfaces.iter().map(|interface| interface.address)
    }

    /// Returns the locators of a port on this machine. The loopback address is announced only if there is no other,
    /// because another machine would take it for its own.
    pub fn locators(&self, port: u16) -> Vec<Locator> {
        let outside: Vec<Ipv4Addr> = self.addresses().filter(|ip| !ip.is_loopback()).collect();
        let told = if outside.is_empty() { vec![Ipv4Addr::LOCALHOST] } else { outside };
        told.into_iter().map(|ip| Locator::from((ip, port))).collect()
    }

    /// Returns whether an address is one of this machine.
    pub fn is_local(&self, ip: IpAddr) -> bool {
        match ip {
            IpAddr::V4(ip) => ip.is_loopback() || self.addresses().any(|own| own == ip),
            IpAddr::V6(ip) => ip.is_loopback(),
        }
    }

    /// Returns whether an address is one of this machine or in one of its networks.
    pub fn is_reachable(&self, ip: IpAddr) -> bool {
        let near = match ip {
            IpAddr::V4(ip) => self.interfaces.iter().any(|it| it.contains(ip)),
            IpAddr::V6(_) => false,
        };
        near || self.is_local(ip)
    }

    /// Chooses the address of a participant with these locators; `heard` is the address from which it was heard, if
    /// known. Returns `None` if none of them leads to it.
    pub fn choose_address(&self, locators: &[Locator], heard: Option<IpAddr>) -> Option<SocketAddr> {
        let udp = locators.iter().filter_map(Locator::udp_address);
        let told: Vec<SocketAddr> = udp.filter(|it| !it.ip().is_multicast()).collect();
        let all_here = told.iter().all(|address| self.is_local(address.ip()));
        let is_here = match heard {
            Some(ip) => self.is_local(ip),
            None => all_here,
        };
        if is_here {
            let loopback = told.iter().find(|address| address.ip().is_loopback());
            let own = || told.iter().find(|address| self.is_local(address.ip()));
            return loopback.or_else(own).or_else(|| told.first()).copied();
        }
        let outside = told.into_iter().filter(|address| !address.ip().is_loopback());
        outside.min_by_key(|address| {
            if Some(address.ip()) == heard {
                return 0;
            }
            match address.ip() {
                ip if self.is_local(ip) => 3,
                IpAddr::V4(ip) if self.interfaces.iter().any(|it| it.contains(ip)) => 1,
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

    fn network(interfaces: &[(&str, u8)]) -> InterfaceSet {
        let of = |(address, prefix): &(&str, u8)| InterfaceAddress { address: ip(address), prefix: *prefix };
        InterfaceSet::new(interfaces.iter().map(of).collect())
    }

    fn choose_ip(network: &InterfaceSet, told: &[&str], heard: Option<&str>) -> Option<String> {
        let told: Vec<Locator> = told.iter().map(|it| Locator::from((ip(it), 7410))).collect();
        let chosen = network.choose_address(&told, heard.map(|heard| ip(heard).into()));
        chosen.map(|address| address.ip().to_string())
    }

    #[test]
    fn whoever_is_elsewhere_is_reached_where_it_was_heard_or_where_both_are() {
        let robot = network(&[("127.0.0.1", 8), ("10.0.0.5", 24), ("192.168.1.5", 24), ("172.17.0.1", 16)]);
        let told = ["172.17.0.1", "10.0.9.7", "192.168.1.7", "10.0.0.7"];
        let to = |heard| choose_ip(&robot, &told, heard);
        assert_eq!(to(Some("10.0.0.7")).as_deref(), Some("10.0.0.7"));
        assert_eq!(to(Some("10.0.9.7")).as_deref(), Some("10.0.9.7"));
        // Through a relay or NAT: one in a common network.
        assert_eq!(to(None).as_deref(), Some("192.168.1.7"));
        assert_eq!(to(Some("10.0.0.77")).as_deref(), Some("192.168.1.7"));
        // No common network: any address of the other machine.
        let far = choose_ip(&robot, &["172.17.0.1", "10.9.9.9"], Some("10.0.0.1"));
        assert_eq!(far.as_deref(), Some("10.9.9.9"));
        // The loopback address of another machine is not ours.
        assert_eq!(choose_ip(&robot, &["127.0.0.1"], Some("10.0.0.7")), None);
        let both = choose_ip(&robot, &["127.0.0.1", "10.0.0.7"], Some("10.0.0.7"));
        assert_eq!(both.as_deref(), Some("10.0.0.7"));
    }

    #[test]
    fn whoever_is_on_this_machine_is_reached_without_its_networks() {
        let robot = network(&[("127.0.0.1", 8), ("10.0.0.5", 24)]);
        let to = |told: &[&str], heard| choose_ip(&robot, told, heard);
        for heard in [None, Some("127.0.0.1"), Some("10.0.0.5")] {
            let both = to(&["10.0.0.5", "127.0.0.1"], heard);
            assert_eq!(both.as_deref(), Some("127.0.0.1"));
            assert_eq!(to(&["10.0.0.5"], heard).as_deref(), Some("10.0.0.5"));
            assert_eq!(to(&["127.0.0.1"], heard).as_deref(), Some("127.0.0.1"));
        }
    }

    #[test]
    fn others_are_told_of_loopback_only_where_there_is_nothing_else() {
        let told = |network: InterfaceSet| -> Vec<String> {
            let locators = network.locators(7411);
            let udp = locators.iter().filter_map(Locator::udp_address);
            udp.map(|address| address.to_string()).collect()
        };
        let robot = network(&[("127.0.0.1", 8), ("10.0.0.5", 24), ("10.1.0.5", 24)]);
        assert_eq!(told(robot), ["10.0.0.5:7411", "10.1.0.5:7411"]);
        assert_eq!(told(network(&[("127.0.0.1", 8)])), ["127.0.0.1:7411"]);
        assert_eq!(told(network(&[])), ["127.0.0.1:7411"]);
    }

    #[test]
    fn nothing_but_the_loopback_device_is_selected_by_default() {
        let found = network(&[("127.0.0.1", 8), ("10.0.0.5", 24)]).interfaces;
        let these = InterfaceSelection::default();
        assert_eq!(these.filter(found), [InterfaceAddress::LOOPBACK]);
        assert!(these.is_loopback() && !InterfaceSelection::All.is_loopback());
    }

    #[test]
    fn a_network_of_one_address_shares_it_with_nobody() {
        let one = InterfaceAddress { address: ip("10.0.0.5"), prefix: 32 };
        assert!(one.contains(ip("10.0.0.5")) && !one.contains(ip("10.0.0.4")));
        let all = InterfaceAddress { prefix: 0, ..one };
        assert!(!all.contains(ip("10.0.0.4")));
    }
}
