//! Where an end receives (9.3.2.3), and which ports a domain has (9.6.2.3).

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

/// Where an end receives. Kinds that are not UDP over IPv4 (shared memory of Fast DDS, TCP) are kept as they came.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Locator {
    /// 1: UDP over IPv4.
    pub kind: i32,
    /// The port.
    pub port: u32,
    /// An IPv4 address is in the last four bytes.
    pub address: [u8; 16],
}

const UDP_V4: i32 = 1;

impl Locator {
    /// The address, where it is one of UDP over IPv4 to which something can be sent.
    pub fn udp(&self) -> Option<SocketAddr> {
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
        Self {
            kind: UDP_V4,
            port: u32::from(port),
            address,
        }
    }
}

/// Where participants announce themselves where a network carries multicast.
pub const MULTICAST: Ipv4Addr = Ipv4Addr::new(239, 255, 0, 1);

/// The ports of one domain.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Ports {
    domain: u16,
}

impl Ports {
    /// Of this domain; at most 232 has all its ports (9.6.2.3).
    pub fn of(domain: u16) -> Option<Self> {
        (domain <= 232).then_some(Self { domain })
    }

    fn base(self) -> u16 {
        7400 + 250 * self.domain
    }

    /// Where all participants hear of each other by multicast.
    pub fn discovery_multicast(self) -> u16 {
        self.base()
    }

    /// Where the participant with this number hears of others; numbers beyond what the domain has ports for have none.
    pub fn discovery(self, number: u16) -> Option<u16> {
        (number < 120).then(|| self.base().saturating_add(10 + 2 * number))
    }

    /// Where the participant with this number is sent samples.
    pub fn user(self, number: u16) -> Option<u16> {
        self.discovery(number).and_then(|port| port.checked_add(1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ports_are_the_specifications() {
        let ports = Ports::of(0).expect("a domain");
        assert_eq!(ports.discovery_multicast(), 7400);
        assert_eq!(
            (ports.discovery(0), ports.user(0)),
            (Some(7410), Some(7411))
        );
        assert_eq!(
            (ports.discovery(3), ports.user(3)),
            (Some(7416), Some(7417))
        );
        assert_eq!(Ports::of(1).expect("a domain").discovery(0), Some(7660));
        assert!(Ports::of(233).is_none());
    }

    #[test]
    fn shared_memory_is_no_address() {
        let udp = Locator::from((Ipv4Addr::LOCALHOST, 7411));
        assert_eq!(udp.udp(), Some(SocketAddr::from(([127, 0, 0, 1], 7411))));
        assert_eq!(Locator { kind: 16, ..udp }.udp(), None);
        assert_eq!(
            Locator {
                port: 70_000,
                ..udp
            }
            .udp(),
            None
        );
        assert_eq!(Locator::from((Ipv4Addr::UNSPECIFIED, 7411)).udp(), None);
    }
}
