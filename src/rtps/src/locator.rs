//! Locators of endpoints (9.3.2.3), and the ports of a domain (9.6.2.3).

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

/// Address at which an endpoint receives. Kinds other than UDP over IPv4 (shared memory of Fast DDS, TCP) are kept
/// unchanged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Locator {
    /// 1: UDP over IPv4.
    pub kind: i32,
    /// Port number.
    pub port: u32,
    /// Address; an IPv4 address is in the last four bytes.
    pub address: [u8; 16],
}

const UDP_V4: i32 = 1;

impl Locator {
    /// Returns the address if it is UDP over IPv4 and can be sent to.
    pub fn udp_address(&self) -> Option<SocketAddr> {
        let [.., a, b, c, d] = self.address;
        let port = u16::try_from(self.port).ok().filter(|port| *port != 0)?;
        let ip = Ipv4Addr::new(a, b, c, d);
        (self.kind == UDP_V4 && !ip.is_unspecified()).then(|| SocketAddr::new(IpAddr::V4(ip), port))
    }
}

impl From<(Ipv4Addr, u16)> for Locator {
    fn from((ip, port): (Ipv4Addr, u16)) -> Self {
        let mut address = [0; 16];
        address[12..].copy_from_slice(&ip.octets());
        Self { kind: UDP_V4, port: u32::from(port), address }
    }
}

/// Multicast address of participant announcements.
pub const MULTICAST: Ipv4Addr = Ipv4Addr::new(239, 255, 0, 1);

/// The ports of one domain.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Ports {
    domain: u16,
}

impl Ports {
    /// Returns the ports of a domain; the highest domain id with all its ports is 232 (9.6.2.3).
    pub fn for_domain(domain: u16) -> Option<Self> {
        (domain <= 232).then_some(Self { domain })
    }

    fn base(self) -> u16 {
        7400 + 250 * self.domain
    }

    /// Returns the port of multicast announcements.
    pub fn discovery_multicast(self) -> u16 {
        self.base()
    }

    /// Returns the discovery port of the participant with this number; `None` if the domain has no port for it.
    pub fn discovery(self, number: u16) -> Option<u16> {
        (number < 120).then(|| self.base().saturating_add(10 + 2 * number))
    }

    /// Returns the port for samples of the participant with this number.
    pub fn user(self, number: u16) -> Option<u16> {
        self.discovery(number).and_then(|port| port.checked_add(1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ports_are_the_specifications() {
        let ports = Ports::for_domain(0).expect("a domain");
        assert_eq!(ports.discovery_multicast(), 7400);
        assert_eq!((ports.discovery(0), ports.user(0)), (Some(7410), Some(7411)));
        assert_eq!((ports.discovery(3), ports.user(3)), (Some(7416), Some(7417)));
        assert_eq!(Ports::for_domain(1).expect("a domain").discovery(0), Some(7660));
        assert!(Ports::for_domain(233).is_none());
    }

    #[test]
    fn shared_memory_is_no_address() {
        let udp = Locator::from((Ipv4Addr::LOCALHOST, 7411));
        assert_eq!(udp.udp_address(), Some(SocketAddr::from(([127, 0, 0, 1], 7411))));
        assert_eq!(Locator { kind: 16, ..udp }.udp_address(), None);
        assert_eq!(Locator { port: 70_000, ..udp }.udp_address(), None);
        assert_eq!(Locator::from((Ipv4Addr::UNSPECIFIED, 7411)).udp_address(), None);
    }
}
