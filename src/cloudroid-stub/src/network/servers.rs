//! Discovery servers of Fast DDS, in the format that its own nodes read: `HOST:PORT;HOST:PORT`. The position of a
//! server in the list is part of its name, so a position can be left empty.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use anyhow::{Context as _, bail};
use ros::DiscoveryServer;

use super::{SERVERS, resolve_ipv4};

/// Default port.
const PORT: u16 = 11811;

/// Resolves the servers of a list.
///
/// # Errors
/// An entry is invalid: its host cannot be resolved, its port is invalid, or it uses another protocol than UDP over
/// IPv4.
pub(super) async fn resolve_servers(list: &str) -> anyhow::Result<Vec<DiscoveryServer>> {
    let mut found = Vec::new();
    for (place, entry) in list.split(';').map(str::trim).enumerate() {
        if entry.is_empty() {
            continue;
        }
        let at = resolve_entry(entry).await.with_context(|| format!("{SERVERS} has {entry:?}"))?;
        let Ok(place) = u8::try_from(place) else {
            bail!("{SERVERS} has more than 256 entries: name fewer servers");
        };
        found.push(DiscoveryServer { place, at });
    }
    Ok(found)
}

async fn resolve_entry(entry: &str) -> anyhow::Result<SocketAddr> {
    if entry.starts_with("TCP") {
        bail!(
            "which uses TCP, but stubs reach discovery servers through UDP only: configure the server to listen on \
                UDP, too, and give HOST:PORT"
        );
    }
    if entry.starts_with("UDPv6:") {
        bail!("but only IPv4 is supported: give an IPv4 address");
    }
    let plain = entry.strip_prefix("UDPv4:").unwrap_or(entry);
    let (host, port) = split_entry(plain)?;
    match resolve_ipv4(host).await? {
        IpAddr::V4(ip) if ip.is_multicast() => {
            bail!("which is a multicast address: give the server's own address")
        }
        // As in Fast DDS: an unspecified address (all addresses of a machine) means this machine.
        ip if ip.is_unspecified() => Ok(SocketAddr::from((Ipv4Addr::LOCALHOST, port))),
        ip => Ok(SocketAddr::new(ip, port)),
    }
}

/// Splits an entry into host and port; the host may be in brackets, as an IPv6 address must be if a port follows.
fn split_entry(entry: &str) -> anyhow::Result<(&str, u16)> {
    let is_bare = |entry: &str| !entry.ends_with(']') && entry.matches(':').count() == 1;
    let (host, port) = match entry.rsplit_once(':') {
        Some((host, port)) if is_bare(entry) || host.ends_with(']') => (host, Some(port)),
        _ => (entry, None),
    };
    if host.is_empty() {
        bail!("which has no host: give HOST:PORT");
    }
    let port = match port.map(str::parse) {
        None => PORT,
        Some(Ok(port)) if port != 0 => port,
        _ => bail!("whose port is invalid: give 1 to 65535, or HOST alone for {PORT}"),
    };
    Ok((host, port))
}

#[cfg(test)]
mod tests {
    use super::*;

    async fn good(list: &str) -> Vec<(u8, String)> {
        let found = resolve_servers(list).await.expect("servers");
        let told = found.iter();
        told.map(|server| (server.place, server.at.to_string())).collect()
    }

    async fn bad(list: &str) -> String {
        let error = resolve_servers(list).await.expect_err("an error");
        format!("{error:#}")
    }

    fn server_at(place: u8, address: &str) -> (u8, String) {
        (place, address.to_owned())
    }

    #[tokio::test]
    async fn a_place_is_part_of_a_name() {
        let found = good("10.0.0.7; ;localhost:14520;UDPv4:[10.0.0.8]:11812;[10.0.0.9]").await;
        let expected = [
            server_at(0, "10.0.0.7:11811"),
            server_at(2, "127.0.0.1:14520"),
            server_at(3, "10.0.0.8:11812"),
            server_at(4, "10.0.0.9:11811"),
        ];
        assert_eq!(found, expected);
        assert_eq!(good("").await, []);
        assert_eq!(good(";;").await, []);
        assert_eq!(good(";0.0.0.0:11888").await, [server_at(1, "127.0.0.1:11888")]);
        let last = format!("{}10.0.0.7", ";".repeat(255));
        assert_eq!(good(&last).await, [server_at(255, "10.0.0.7:11811")]);
    }

    #[tokio::test]
    async fn what_is_no_server_is_named() {
        for (list, entry, reason) in [
            ("10.0.0.7:0", "10.0.0.7:0", "give 1 to 65535"),
            ("10.0.0.7;10.0.0.8:70000", "10.0.0.8:70000", "give 1 to 65535"),
            ("10.0.0.7:x", "10.0.0.7:x", "give 1 to 65535"),
            (":11811", ":11811", "no host"),
            ("TCPv4:[10.0.0.7]:42100", "TCPv4:[10.0.0.7]:42100", "uses TCP"),
            ("UDPv6:[::1]:11811", "UDPv6:[::1]:11811", "only IPv4"),
            ("[::1]:11811", "[::1]:11811", "only IPv4"),
            ("::1", "::1", "only IPv4"),
            ("239.255.0.1:11811", "239.255.0.1:11811", "a multicast address"),
            ("a..b:11811", "a..b:11811", "a..b"),
        ] {
            let told = bad(list).await;
            let begin = format!("ROS_DISCOVERY_SERVER has {entry:?}: ");
            assert!(told.starts_with(&begin) && told.contains(reason), "{told}");
        }
        let many = format!("{}10.0.0.7", ";".repeat(256));
        assert!(bad(&many).await.contains("more than 256 entries"));
    }
}
