//! The private system of a local original of ROS 2: a domain of DDS that nobody else on this machine is in, on loopback.
//!
//! Two domains do not hear each other, so nothing of the original's reaches the robot's nodes, and nothing of theirs reaches it. The
//! process is told by its environment which domain it is in, and that nodes are on this machine alone; its command line stays as
//! it is.

use std::net::{Ipv4Addr, UdpSocket};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener};
use std::sync::Arc;

use anyhow::{Context, bail};
use rand::seq::SliceRandom;
use ros::bus::{Bus, RosVersion};
use ros::net::HostSockets;
use ros::{JoinOptions, Network};

use super::private_system::{NODE, Variables};

/// The domains to choose from. The ports of those beyond are among those that the kernel gives away, and 0 is everybody's.
const DOMAINS: std::ops::RangeInclusive<u16> = 1..=101;
/// Ports of domains (RTPS 2.5, 9.6.1.1): of the first domain, between two domains, and, within a domain, of multicast and of the
/// first participants.
const FIRST_PORT: u16 = 7400;
const PORTS: u16 = 250;
const OFFSETS: [u16; 5] = [0, 1, 10, 11, 12];
/// Distributions that know nothing of ranges of discovery; later ones warn of the variable.
const LOCALHOST_ONLY: [&str; 5] = ["dashing", "eloquent", "foxy", "galactic", "humble"];
/// Which nodes are looked for where, and settings of the networks of DDS: they are about the robot's. A profile that binds a node
/// to a network card, say, would keep it from this system.
const OF_NETWORKS: [&str; 7] = [
    "ROS_DISCOVERY_SERVER",
    "ROS_SUPER_CLIENT",
    "ROS_STATIC_PEERS",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTDDS_ENVIRONMENT_FILE",
    "CYCLONEDDS_URI",
];

/// A domain; it is free for others when this ends.
pub struct PrivateDomain {
    id: u16,
    /// By which other stubs know that it is taken.
    _taken: UnixListener,
}

impl PrivateDomain {
    /// Takes one, with a node there. `taken` is the robot's.
    pub async fn new(taken: Option<u16>) -> anyhow::Result<(Self, Arc<dyn Bus>)> {
        let domain = Self::take(taken)?;
        let options = JoinOptions {
            distribution: std::env::var("ROS_DISTRO").unwrap_or_default(),
            // Nodes that look on this machine alone ask at the ports that the first of it take.
            network: Network {
                well_known: true,
                ..Network::default()
            },
            ..JoinOptions::in_domain(domain.id, NODE)
        };
        let joined = ros::connect(RosVersion::Two, Arc::new(HostSockets), options).await;
        let bus = joined.with_context(|| format!("a private ROS domain ({})", domain.id))?;
        Ok((domain, bus))
    }

    /// Its number.
    #[cfg(test)]
    pub fn id(&self) -> u16 {
        self.id
    }

    /// Any that nobody is in.
    pub fn take(taken: Option<u16>) -> anyhow::Result<Self> {
        let mut free: Vec<u16> = DOMAINS.filter(|id| Some(*id) != taken).collect();
        // Stubs that are started together do not try the same ones.
        free.shuffle(&mut rand::rng());
        for id in free {
            let name = SocketAddr::from_abstract_name(format!("cloudroid-domain-{id}"))?;
            let Ok(lock) = UnixListener::bind_addr(&name) else {
                continue;
            };
            if is_free(id) {
                return Ok(Self { id, _taken: lock });
            }
        }
        bail!(
            "no ROS domain from {} to {} is free for the local original: each has nodes on this machine; end some of them, or set local = \"none\" in stub.toml",
            DOMAINS.start(),
            DOMAINS.end()
        )
    }

    /// What a process is told by, so that its nodes are here.
    pub fn environment(&self) -> Variables {
        let distribution = std::env::var("ROS_DISTRO").unwrap_or_default();
        self.environment_of(&distribution)
    }

    fn environment_of(&self, distribution: &str) -> Variables {
        let only = LOCALHOST_ONLY.contains(&distribution);
        let mut variables: Variables = vec![
            ("ROS_DOMAIN_ID", Some(self.id.to_string().into())),
            ("ROS_AUTOMATIC_DISCOVERY_RANGE", Some("LOCALHOST".into())),
            ("ROS_LOCALHOST_ONLY", only.then(|| "1".into())),
        ];
        variables.extend(OF_NETWORKS.map(|name| (name, None)));
        variables
    }
}

/// Whether no participant of this machine is in the domain: its first ones take the ports that are looked at.
fn is_free(id: u16) -> bool {
    OFFSETS.into_iter().all(|offset| {
        let port = FIRST_PORT + PORTS * id + offset;
        UdpSocket::bind((Ipv4Addr::UNSPECIFIED, port)).is_ok()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_two_stubs_take_the_same_domain_nor_one_with_nodes() {
        let one = PrivateDomain::take(Some(5)).unwrap();
        assert!(DOMAINS.contains(&one.id) && one.id != 5);
        let name = format!("cloudroid-domain-{}", one.id);
        let again = SocketAddr::from_abstract_name(&name).unwrap();
        assert!(UnixListener::bind_addr(&again).is_err());
        assert!(is_free(one.id));
        let port = FIRST_PORT + PORTS * one.id + 10;
        let node = UdpSocket::bind((Ipv4Addr::LOCALHOST, port)).unwrap();
        assert!(!is_free(one.id));
        drop((node, one));
        assert!(UnixListener::bind_addr(&again).is_ok());
    }

    #[test]
    fn a_process_is_told_the_domain_and_nothing_of_the_robot_s_networks() {
        let domain = PrivateDomain::take(None).unwrap();
        let value = |distribution: &str, name: &str| {
            let all = domain.environment_of(distribution);
            let found = all.into_iter().find(|(known, _)| *known == name);
            found.expect("it is set or unset").1
        };
        let id = domain.id.to_string();
        assert_eq!(value("jazzy", "ROS_DOMAIN_ID"), Some(id.into()));
        assert_eq!(value("jazzy", "ROS_LOCALHOST_ONLY"), None);
        assert_eq!(value("humble", "ROS_LOCALHOST_ONLY"), Some("1".into()));
        assert_eq!(value("jazzy", "ROS_DISCOVERY_SERVER"), None);
        assert_eq!(value("jazzy", "CYCLONEDDS_URI"), None);
    }
}
