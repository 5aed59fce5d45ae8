//! Private system of a local original for ROS 2: a DDS domain on loopback that no other node of this machine is in.
//!
//! Nodes of different domains do not communicate, so nothing of the original reaches the robot's nodes, and vice versa.
//! The process gets the domain, and the restriction to this machine, from its environment; its command line is not
//! changed.

use std::net::{Ipv4Addr, UdpSocket};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener};
use std::sync::Arc;

use anyhow::{Context, bail};
use rand::seq::SliceRandom;
use ros::bus::{Bus, RosVersion};
use ros::net::HostSockets;
use ros::{DiscoveryNetwork, JoinOptions};

use super::private_system::{NODE, Variables};

/// Domains to choose from. The ports of higher ones are in the kernel's ephemeral range, and 0 is the default domain.
const DOMAINS: std::ops::RangeInclusive<u16> = 1..=101;
/// Ports of domains (RTPS 2.5, 9.6.1.1): of the first domain, between two domains, and the offsets of multicast and of
/// the first participants within a domain.
const FIRST_PORT: u16 = 7400;
const PORTS: u16 = 250;
const OFFSETS: [u16; 5] = [0, 1, 10, 11, 12];
/// Distributions without discovery ranges; later ones warn about the variable.
const LOCALHOST_ONLY: [&str; 5] = ["dashing", "eloquent", "foxy", "galactic", "humble"];
/// Variables that select discovery peers and configure the networks of DDS for the robot. A profile that binds a node
/// to a network interface, for example, would separate it from this system.
const OF_NETWORKS: [&str; 7] = [
    "ROS_DISCOVERY_SERVER",
    "ROS_SUPER_CLIENT",
    "ROS_STATIC_PEERS",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTDDS_ENVIRONMENT_FILE",
    "CYCLONEDDS_URI",
];

/// A domain, which is released when this is dropped.
pub struct PrivateDomain {
    id: u16,
    /// Abstract socket by which other stubs see that the domain is taken.
    _taken: UnixListener,
}

impl PrivateDomain {
    /// Takes a domain and joins it as a node. `taken` is the robot's domain.
    pub async fn new(taken: Option<u16>) -> anyhow::Result<(Self, Arc<dyn Bus>)> {
        let domain = Self::take(taken)?;
        let options = JoinOptions {
            distribution: std::env::var("ROS_DISTRO").unwrap_or_default(),
            // Nodes that look on this machine only send to the ports of its first participants.
            network: DiscoveryNetwork { well_known: true, ..DiscoveryNetwork::default() },
            ..JoinOptions::in_domain(domain.id, NODE)
        };
        let joined = ros::connect(RosVersion::Two, Arc::new(HostSockets), options).await;
        let bus = joined.with_context(|| format!("a private ROS domain ({})", domain.id))?;
        Ok((domain, bus))
    }

    /// Returns the id of the domain.
    #[cfg(test)]
    pub fn id(&self) -> u16 {
        self.id
    }

    /// Takes a domain without participants.
    pub fn take(taken: Option<u16>) -> anyhow::Result<Self> {
        let mut free: Vec<u16> = DOMAINS.filter(|id| Some(*id) != taken).collect();
        // Stubs that start together try different domains.
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
            "no ROS domain from {} to {} is free for the local original: each has nodes on this machine; stop some of \
                them, or set local = \"none\" in stub.toml",
            DOMAINS.start(),
            DOMAINS.end()
        )
    }

    /// Returns the variables that put the nodes of a process into this domain.
    pub fn environment(&self) -> Variables {
        let distribution = std::env::var("ROS_DISTRO").unwrap_or_default();
        self.environment_for(&distribution)
    }

    fn environment_for(&self, distribution: &str) -> Variables {
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

/// Returns whether no participant of this machine is in the domain: its first ones would have taken the checked ports.
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
            let all = domain.environment_for(distribution);
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
