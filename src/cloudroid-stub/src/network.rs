//! Discovery settings of a ROS 2 stub, read from the same environment variables as ROS 2 nodes read (docs.ros.org,
//! "Improved Dynamic Discovery").

mod servers;

use std::net::{IpAddr, SocketAddr};

use anyhow::bail;
use ros::{DiscoveryNetwork, InterfaceSelection};

use self::servers::resolve_servers;
use crate::resolver;

const DOMAIN: &str = "ROS_DOMAIN_ID";
const RANGE: &str = "ROS_AUTOMATIC_DISCOVERY_RANGE";
const LOCALHOST_ONLY: &str = "ROS_LOCALHOST_ONLY";
const PEERS: &str = "ROS_STATIC_PEERS";
const SERVERS: &str = "ROS_DISCOVERY_SERVER";

/// Highest domain whose ports all exist (DDSI-RTPS 2.5, 9.6.2.3).
const LAST_DOMAIN: u16 = 232;

/// Looks up an environment variable.
pub type Variable<'a> = &'a (dyn Fn(&str) -> Option<String> + Sync);

/// Range within which a node discovers others by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum DiscoveryRange {
    Off,
    Localhost,
    Subnet,
}

/// Returns the domain and the network of a node in this environment.
///
/// # Errors
/// A variable has a value that ROS 2 does not accept, or names a discovery server that cannot be resolved or uses an
/// unsupported protocol. A peer that cannot be resolved is reported in the log, as ROS 2 nodes do, and skipped.
pub async fn read_network(variable: Variable<'_>) -> anyhow::Result<(u16, DiscoveryNetwork)> {
    let given = |name: &str| variable(name).filter(|value| !value.is_empty());
    let domain = parse_domain(given(DOMAIN).as_deref())?;
    let this_machine = parse_localhost_only(given(LOCALHOST_ONLY).as_deref())?;
    let range = if this_machine { DiscoveryRange::Localhost } else { parse_range(given(RANGE).as_deref())? };
    if range == DiscoveryRange::Off {
        let alone = DiscoveryNetwork { alone: true, multicast: false, ..DiscoveryNetwork::default() };
        return Ok((domain, alone));
    }
    // If discovery is limited to this machine, ROS 2 does not read the peers either.
    let peers = given(PEERS).filter(|_| !this_machine);
    let mut peers = resolve_peers(&peers.unwrap_or_default()).await;
    let servers = resolve_servers(&given(SERVERS).unwrap_or_default()).await?;
    if !servers.is_empty() && !peers.is_empty() {
        tracing::warn!("{PEERS} is ignored because {SERVERS} is set, as in Fast DDS");
        peers.clear();
    }
    let mut named = servers.iter().map(|server| &server.at).chain(&peers);
    let is_wide = range == DiscoveryRange::Subnet || named.any(|address| !address.ip().is_loopback());
    let network = DiscoveryNetwork {
        interfaces: if is_wide && !this_machine { InterfaceSelection::All } else { InterfaceSelection::default() },
        multicast: range == DiscoveryRange::Subnet && servers.is_empty(),
        alone: false,
        peers,
        servers,
        well_known: true,
    };
    Ok((domain, network))
}

fn parse_domain(given: Option<&str>) -> anyhow::Result<u16> {
    let Some(given) = given else {
        return Ok(0);
    };
    match given.parse() {
        Ok(domain) if domain <= LAST_DOMAIN => Ok(domain),
        _ => bail!("{DOMAIN} is {given:?}: expected a number from 0 to {LAST_DOMAIN}"),
    }
}

fn parse_range(given: Option<&str>) -> anyhow::Result<DiscoveryRange> {
    match given {
        // The default of the DDS implementation is the same.
        None | Some("SUBNET" | "SYSTEM_DEFAULT") => Ok(DiscoveryRange::Subnet),
        Some("LOCALHOST") => Ok(DiscoveryRange::Localhost),
        Some("OFF") => Ok(DiscoveryRange::Off),
        Some(other) => {
            bail!("{RANGE} is {other:?}: expected SUBNET, LOCALHOST, OFF or SYSTEM_DEFAULT")
        }
    }
}

fn parse_localhost_only(given: Option<&str>) -> anyhow::Result<bool> {
    match given {
        None | Some("0") => Ok(false),
        Some("1") => Ok(true),
        Some(other) => bail!("{LOCALHOST_ONLY} is {other:?}: expected 0 or 1"),
    }
}

fn entries(list: &str) -> impl Iterator<Item = &str> {
    list.split(';').map(str::trim).filter(|entry| !entry.is_empty())
}

/// Resolves the peers, each with port 0, which stands for the ports of all nodes on a host.
async fn resolve_peers(list: &str) -> Vec<SocketAddr> {
    let mut found = Vec::new();
    for host in entries(list) {
        match resolve_ipv4(host).await {
            Ok(ip) => found.push(SocketAddr::new(ip, 0)),
            Err(error) => {
                tracing::warn!("{PEERS} has {host}, which is skipped: {error:#}; its nodes do not discover this one")
            }
        }
    }
    found
}

async fn resolve_ipv4(host: &str) -> anyhow::Result<IpAddr> {
    let ip = resolver::resolve(host).await?;
    if ip.is_ipv6() {
        bail!("its address is {ip}, but only IPv4 is supported: give an IPv4 address");
    }
    Ok(ip)
}

#[cfg(test)]
mod tests {
    use super::*;

    async fn parse_network(given: &[(&str, &str)]) -> anyhow::Result<(u16, DiscoveryNetwork)> {
        let variable = |name: &str| {
            let mut given = given.iter();
            given.find(|(given, _)| *given == name).map(|(_, value)| (*value).to_owned())
        };
        read_network(&variable).await
    }

    async fn good(given: &[(&str, &str)]) -> (u16, DiscoveryNetwork) {
        parse_network(given).await.expect("a network")
    }

    async fn bad(given: &[(&str, &str)]) -> String {
        format!("{:#}", parse_network(given).await.expect_err("an error"))
    }

    fn addresses(list: &[&str]) -> Vec<SocketAddr> {
        let parse = |text: &&str| text.parse().expect("an address");
        list.iter().map(parse).collect()
    }

    #[tokio::test]
    async fn without_a_word_all_networks_are_used() {
        let wide =
            DiscoveryNetwork { interfaces: InterfaceSelection::All, well_known: true, ..DiscoveryNetwork::default() };
        assert_eq!(good(&[]).await, (0, wide.clone()));
        // A variable set to an empty string in the shell.
        let empty = [DOMAIN, RANGE, LOCALHOST_ONLY, PEERS, SERVERS].map(|name| (name, ""));
        assert_eq!(good(&empty).await, (0, wide.clone()));
        for range in ["SUBNET", "SYSTEM_DEFAULT"] {
            assert_eq!(good(&[(RANGE, range)]).await, (0, wide.clone()));
        }
    }

    #[tokio::test]
    async fn the_domain_is_read() {
        assert_eq!(good(&[(DOMAIN, "232")]).await.0, 232);
        for (given, quoted) in [("233", "\"233\""), ("-1", "\"-1\""), ("robot", "\"robot\"")] {
            assert_eq!(
                bad(&[(DOMAIN, given)]).await,
                format!("ROS_DOMAIN_ID is {quoted}: expected a number from 0 to 232")
            );
        }
    }

    #[tokio::test]
    async fn this_machine_alone() {
        let narrow = DiscoveryNetwork { multicast: false, well_known: true, ..DiscoveryNetwork::default() };
        assert_eq!(good(&[(RANGE, "LOCALHOST")]).await.1, narrow);
        // The older variable has precedence over both.
        let older = [(LOCALHOST_ONLY, "1"), (RANGE, "SUBNET"), (PEERS, "10.0.0.7")];
        assert_eq!(good(&older).await.1, narrow);
        assert_eq!(good(&[(LOCALHOST_ONLY, "0")]).await.1, good(&[]).await.1, "0 is as nothing");
        // Peers on other machines must be able to reach this node.
        let (_, peers) = good(&[(RANGE, "LOCALHOST"), (PEERS, "10.0.0.7")]).await;
        assert_eq!((peers.interfaces, peers.multicast), (InterfaceSelection::All, false));
        assert_eq!(bad(&[(LOCALHOST_ONLY, "yes")]).await, "ROS_LOCALHOST_ONLY is \"yes\": expected 0 or 1");
    }

    #[tokio::test]
    async fn nobody_at_all() {
        let (_, off) = good(&[(RANGE, "OFF"), (PEERS, "10.0.0.7")]).await;
        assert!(off.alone && !off.multicast && off.peers.is_empty());
        assert_eq!(
            bad(&[(RANGE, "off")]).await,
            "ROS_AUTOMATIC_DISCOVERY_RANGE is \"off\": expected SUBNET, LOCALHOST, OFF or SYSTEM_DEFAULT"
        );
    }

    #[tokio::test]
    async fn peers_are_found_and_others_left_out() {
        let list = "10.0.0.7; localhost;;10.0.0.8;a..b;::1";
        let (_, network) = good(&[(PEERS, list)]).await;
        let expected = addresses(&["10.0.0.7:0", "127.0.0.1:0", "10.0.0.8:0"]);
        assert_eq!((network.peers, network.multicast), (expected, true));
    }

    #[tokio::test]
    async fn where_servers_are_named_nothing_else_is_looked_at() {
        let given = [(SERVERS, ";10.0.0.7:11888"), (PEERS, "10.0.0.8")];
        let (_, network) = good(&given).await;
        let [server] = network.servers[..] else {
            panic!("{network:?}");
        };
        assert_eq!((server.place, server.at.port()), (1, 11888));
        assert!(!network.multicast && network.peers.is_empty());
        assert_eq!(network.interfaces, InterfaceSelection::All);
        // A server on another machine must be able to reach this node; one on this machine is reached on the loopback
        // interface.
        let of = |server| [(SERVERS, server), (RANGE, "LOCALHOST")];
        let interfaces = |(_, network): (u16, DiscoveryNetwork)| network.interfaces;
        assert_eq!(interfaces(good(&of("10.0.0.7")).await), InterfaceSelection::All);
        let here = interfaces(good(&of("127.0.0.1")).await);
        assert_eq!(here, InterfaceSelection::default());
        let told = bad(&[(SERVERS, "10.0.0.7;TCPv4:[10.0.0.8]:42100")]).await;
        assert!(told.contains("TCPv4:[10.0.0.8]:42100"), "{told}");
        // A list of empty entries.
        assert!(good(&[(SERVERS, ";")]).await.1.multicast);
    }
}
