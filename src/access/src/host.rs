//! Hosts behind addresses: limits count by host, because one host can use many addresses.

use std::cmp::Reverse;
use std::collections::HashMap;
use std::net::{IpAddr, Ipv6Addr};

/// Addresses that belong together: an IPv4 address, an IPv6 network of one host, or a wider network of many hosts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Host {
    address: IpAddr,
    /// Length of the prefix in bits.
    prefix: u32,
}

/// IPv6 prefix lengths in bits of a host, a site (RFC 6177) and a provider.
pub(crate) const OF_HOST: u32 = 64;
pub(crate) const OF_SITE: u32 = 48;
pub(crate) const OF_PROVIDER: u32 = 32;

impl From<IpAddr> for Host {
    fn from(address: IpAddr) -> Host {
        let host = Host { address: address.to_canonical(), prefix: 0 };
        host.network_with_prefix(OF_HOST)
    }
}

impl Host {
    /// Returns the enclosing network with this prefix length; for IPv4, where addresses are scarce, the host itself.
    pub(crate) fn network_with_prefix(self, prefix: u32) -> Host {
        match self.address {
            IpAddr::V4(_) => Host { prefix: 32, ..self },
            IpAddr::V6(address) => {
                let network = u128::from(address) & (u128::MAX << (128 - prefix));
                Host { address: IpAddr::V6(Ipv6Addr::from(network)), prefix }
            }
        }
    }

    /// Returns true for IPv6, where one owner has very many addresses.
    pub(crate) fn is_ipv6(self) -> bool {
        self.address.is_ipv6()
    }

    /// Returns the network assigned to the host's owner: a site for IPv6, the address itself for IPv4.
    pub fn network(self) -> Host {
        self.network_with_prefix(OF_SITE)
    }
}

/// Returns the network with the most hosts; among equals, the first.
pub fn largest_network(hosts: impl Iterator<Item = Host>) -> Option<Host> {
    let mut counts: HashMap<Host, (usize, Reverse<usize>)> = HashMap::new();
    for (place, host) in hosts.enumerate() {
        let first = (0, Reverse(place));
        counts.entry(host.network()).or_insert(first).0 += 1;
    }
    let largest = counts.into_iter().max_by_key(|(_, count)| *count);
    largest.map(|(network, _)| network)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_network_is_that_of_most_hosts_or_the_first_of_as_many() {
        let largest = |hosts: &[&str]| {
            let hosts = hosts.iter().map(|host| {
                let address: IpAddr = host.parse().expect("an address");
                Host::from(address)
            });
            largest_network(hosts)
        };
        let network = |host: &str| {
            let address: IpAddr = host.parse().expect("an address");
            Some(Host::from(address).network())
        };
        assert_eq!(largest(&[]), None);
        let of_site = ["192.0.2.1", "2001:db8:0:1::1", "2001:db8:0:2::1", "192.0.2.2"];
        assert_eq!(largest(&of_site), network("2001:db8::9"));
        let alike = ["192.0.2.7", "192.0.2.1", "2001:db8::1", "192.0.2.9"];
        assert_eq!(largest(&alike), network("192.0.2.7"));
    }
}
