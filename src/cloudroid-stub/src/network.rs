//! Where a stub of ROS 2 looks for the robot's nodes: what the environment says, by the names and values that ROS 2's own nodes
//! read (docs.ros.org, "Improved Dynamic Discovery").

mod servers;

use std::net::{IpAddr, SocketAddr};

use anyhow::bail;
use ros::{Interfaces, Network};

use self::servers::servers_found;
use crate::resolver;

const DOMAIN: &str = "ROS_DOMAIN_ID";
const RANGE: &str = "ROS_AUTOMATIC_DISCOVERY_RANGE";
const LOCALHOST_ONLY: &str = "ROS_LOCALHOST_ONLY";
const PEERS: &str = "ROS_STATIC_PEERS";
const SERVERS: &str = "ROS_DISCOVERY_SERVER";

/// The last domain that has all its ports (DDSI-RTPS 2.5, 9.6.2.3).
const LAST_DOMAIN: u16 = 232;

/// Looks a variable of the environment up.
pub type Variable<'a> = &'a (dyn Fn(&str) -> Option<String> + Sync);

/// How far a node looks for others by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Range {
    Off,
    Localhost,
    Subnet,
}

/// The domain and the network of a node in this environment.
///
/// # Errors
/// A variable has a value that ROS 2 does not know, or names a discovery server that cannot be found or spoken with. A peer that
/// cannot be found is named in the log, as by ROS 2's nodes, and left out.
pub async fn network(variable: Variable<'_>) -> anyhow::Result<(u16, Network)> {
    let given = |name: &str| variable(name).filter(|value| !value.is_empty());
    let domain = domain(given(DOMAIN).as_deref())?;
    let this_machine = localhost_only(given(LOCALHOST_ONLY).as_deref())?;
    let range = match this_machine {
        true => Range::Localhost,
        false => range(given(RANGE).as_deref())?,
    };
    if range == Range::Off {
        let alone = Network {
            alone: true,
            multicast: false,
            ..Network::default()
        };
        return Ok((domain, alone));
    }
    // Where it is only for this machine, ROS 2 does not read it either.
    let peers = given(PEERS).filter(|_| !this_machine);
    let mut peers = peers_found(&peers.unwrap_or_default()).await;
    let servers = servers_found(&given(SERVERS).unwrap_or_default()).await?;
    if !servers.is_empty() && !peers.is_empty() {
        tracing::warn!("{PEERS} is not used where {SERVERS} is, as by Fast DDS");
        peers.clear();
    }
    let mut named = servers.iter().map(|server| &server.at).chain(&peers);
    let is_wide = range == Range::Subnet || named.any(|address| !address.ip().is_loopback());
    let network = Network {
        interfaces: match is_wide && !this_machine {
            true => Interfaces::All,
            false => Interfaces::default(),
        },
        multicast: range == Range::Subnet && servers.is_empty(),
        alone: false,
        peers,
        servers,
        well_known: true,
    };
    Ok((domain, network))
}

fn domain(given: Option<&str>) -> anyhow::Result<u16> {
    let Some(given) = given else {
        return Ok(0);
    };
    match given.parse() {
        Ok(domain) if domain <= LAST_DOMAIN => Ok(domain),
        _ => bail!("{DOMAIN} is {given:?}: give a number from 0 to {LAST_DOMAIN}"),
    }
}

fn range(given: Option<&str>) -> anyhow::Result<Range> {
    match given {
        // What the implementation of DDS does where nobody says anything is the same.
        None | Some("SUBNET" | "SYSTEM_DEFAULT") => Ok(Range::Subnet),
        Some("LOCALHOST") => Ok(Range::Localhost),
        Some("OFF") => Ok(Range::Off),
        Some(other) => {
            bail!("{RANGE} is {other:?}: give SUBNET, LOCALHOST, OFF or SYSTEM_DEFAULT")
        }
    }
}

fn localhost_only(given: Option<&str>) -> anyhow::Result<bool> {
    match given {
        None | Some("0") => Ok(false),
        Some("1") => Ok(true),
        Some(other) => bail!("{LOCALHOST_ONLY} is {other:?}: give 0 or 1"),
    }
}

fn entries(list: &str) -> impl Iterator<Item = &str> {
    list.split(';')
        .map(str::trim)
        .filter(|entry| !entry.is_empty())
}

/// Each with port 0, which stands for those of all nodes of a host.
async fn peers_found(list: &str) -> Vec<SocketAddr> {
    let mut found = Vec::new();
    for host in entries(list) {
        match address(host).await {
            Ok(ip) => found.push(SocketAddr::new(ip, 0)),
            Err(error) => tracing::warn!(
                "{PEERS} names {host}, which is left out: {error:#}; its nodes are not told of this one"
            ),
        }
    }
    found
}

async fn address(host: &str) -> anyhow::Result<IpAddr> {
    let ip = resolver::resolve(host).await?;
    if ip.is_ipv6() {
        bail!("its address is {ip}, and only IPv4 is spoken here: give an address of IPv4");
    }
    Ok(ip)
}

#[cfg(test)]
mod tests {
    use super::*;

    async fn of(given: &[(&str, &str)]) -> anyhow::Result<(u16, Network)> {
        let variable = |name: &str| {
            let mut given = given.iter();
            given
                .find(|(given, _)| *given == name)
                .map(|(_, value)| (*value).to_owned())
        };
        network(&variable).await
    }

    async fn good(given: &[(&str, &str)]) -> (u16, Network) {
        of(given).await.expect("a network")
    }

    async fn bad(given: &[(&str, &str)]) -> String {
        format!("{:#}", of(given).await.expect_err("an error"))
    }

    fn addresses(list: &[&str]) -> Vec<SocketAddr> {
        let parse = |text: &&str| text.parse().expect("an address");
        list.iter().map(parse).collect()
    }

    #[tokio::test]
    async fn without_a_word_all_networks_are_used() {
        let wide = Network {
            interfaces: Interfaces::All,
            well_known: true,
            ..Network::default()
        };
        assert_eq!(good(&[]).await, (0, wide.clone()));
        // As set to nothing in a shell.
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
                format!("ROS_DOMAIN_ID is {quoted}: give a number from 0 to 232")
            );
        }
    }

    #[tokio::test]
    async fn this_machine_alone() {
        let narrow = Network {
            multicast: false,
            well_known: true,
            ..Network::default()
        };
        assert_eq!(good(&[(RANGE, "LOCALHOST")]).await.1, narrow);
        // The older variable stands above both.
        let older = [
            (LOCALHOST_ONLY, "1"),
            (RANGE, "SUBNET"),
            (PEERS, "10.0.0.7"),
        ];
        assert_eq!(good(&older).await.1, narrow);
        assert_eq!(
            good(&[(LOCALHOST_ONLY, "0")]).await.1,
            good(&[]).await.1,
            "0 is as nothing"
        );
        // Peers elsewhere have to reach us.
        let (_, peers) = good(&[(RANGE, "LOCALHOST"), (PEERS, "10.0.0.7")]).await;
        assert_eq!(
            (peers.interfaces, peers.multicast),
            (Interfaces::All, false)
        );
        assert_eq!(
            bad(&[(LOCALHOST_ONLY, "yes")]).await,
            "ROS_LOCALHOST_ONLY is \"yes\": give 0 or 1"
        );
    }

    #[tokio::test]
    async fn nobody_at_all() {
        let (_, off) = good(&[(RANGE, "OFF"), (PEERS, "10.0.0.7")]).await;
        assert!(off.alone && !off.multicast && off.peers.is_empty());
        assert_eq!(
            bad(&[(RANGE, "off")]).await,
            "ROS_AUTOMATIC_DISCOVERY_RANGE is \"off\": give SUBNET, LOCALHOST, OFF or SYSTEM_DEFAULT"
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
        assert_eq!(network.interfaces, Interfaces::All);
        // A server elsewhere has to reach us, one here has not.
        let of = |server| [(SERVERS, server), (RANGE, "LOCALHOST")];
        let interfaces = |(_, network): (u16, Network)| network.interfaces;
        assert_eq!(interfaces(good(&of("10.0.0.7")).await), Interfaces::All);
        let here = interfaces(good(&of("127.0.0.1")).await);
        assert_eq!(here, Interfaces::default());
        let told = bad(&[(SERVERS, "10.0.0.7;TCPv4:[10.0.0.8]:42100")]).await;
        assert!(told.contains("TCPv4:[10.0.0.8]:42100"), "{told}");
        // Nothing but places of servers that are not there.
        assert!(good(&[(SERVERS, ";")]).await.1.multicast);
    }
}
