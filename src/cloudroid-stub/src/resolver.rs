//! Resolves host names without the C library, since a static program has no NSS: first `/etc/hosts`, then multicast DNS
//! for `.local` (RFC 6762), otherwise the servers of `/etc/resolv.conf` (RFC 1035). Nothing is cached, because a robot
//! moves between networks, where both the files and the answers change.

use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::os::fd::OwnedFd;
use std::time::Duration;

use async_trait::async_trait;
use hickory_resolver::config::{LookupIpStrategy, ResolveHosts, ResolverConfig, ResolverOpts};
use hickory_resolver::name_server::TokioConnectionProvider;
use hickory_resolver::proto::op::Query;
use hickory_resolver::proto::rr::{Name, RecordType};
use hickory_resolver::system_conf::read_system_conf;
use hickory_resolver::{Hosts, TokioResolver};
use mdns_sd::{HostnameResolutionEvent, ServiceDaemon};
use ros::InterfaceAddress;
use ros::net::{HostSockets, Sockets};
use tokio::net::{TcpListener, TcpStream, UdpSocket};

/// Timeout for hosts of this network to answer; queries are sent at 0 and 1 s.
const MULTICAST: Duration = Duration::from_millis(1800);
/// Timeout for one query to one server.
const ANSWER: Duration = Duration::from_millis(1500);
const ATTEMPTS: usize = 3;

/// The robot's network with this resolver.
#[derive(Debug, Clone, Copy, Default)]
pub struct RobotSockets;

#[async_trait]
impl Sockets for RobotSockets {
    async fn connect(&self, address: SocketAddr) -> io::Result<TcpStream> {
        HostSockets.connect(address).await
    }

    async fn listen(&self, address: SocketAddr) -> io::Result<TcpListener> {
        HostSockets.listen(address).await
    }

    async fn resolve(&self, host: &str, port: u16) -> io::Result<SocketAddr> {
        Ok(SocketAddr::new(resolve(host).await?, port))
    }

    async fn bind_udp(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket> {
        HostSockets.bind_udp(address, shared).await
    }

    async fn interfaces(&self) -> io::Result<Vec<InterfaceAddress>> {
        HostSockets.interfaces().await
    }

    async fn open_sock_diag(&self) -> io::Result<Option<OwnedFd>> {
        HostSockets.open_sock_diag().await
    }
}

/// Returns the address of a host, IPv4 before IPv6, because ROS 1 nodes listen on IPv4.
///
/// # Errors
/// `NotFound`, with the servers that were queried, if the name does not exist; otherwise the reason why the query
/// failed.
pub async fn resolve(host: &str) -> io::Result<IpAddr> {
    let bare = host.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')).unwrap_or(host);
    if let Ok(literal) = bare.parse() {
        return Ok(literal);
    }
    let name = bare.trim_end_matches('.').to_ascii_lowercase();
    let parsed = Name::from_utf8(&name)
        .map_err(|error| io::Error::new(io::ErrorKind::InvalidInput, format!("{name}: {error}")))?;
    if let Some(known) = lookup_hosts_file(&parsed) {
        return Ok(known);
    }
    if name == "localhost" || name.ends_with(".localhost") {
        return Ok(Ipv4Addr::LOCALHOST.into());
    }
    if name.ends_with(".local") {
        return resolve_multicast(&name).await;
    }
    resolve_dns(&name, parsed).await
}

fn not_found(name: &str, asked: &str) -> io::Error {
    io::Error::new(io::ErrorKind::NotFound, format!("host {name} has no address: {asked}"))
}

fn lookup_hosts_file(name: &Name) -> Option<IpAddr> {
    let hosts = Hosts::from_system().ok()?;
    [RecordType::A, RecordType::AAAA].into_iter().find_map(|kind| {
        let found = hosts.lookup_static_host(&Query::query(name.clone(), kind))?;
        found.iter().find_map(hickory_resolver::proto::rr::RData::ip_addr)
    })
}

/// Queries the hosts on all networks of this machine.
async fn resolve_multicast(name: &str) -> io::Result<IpAddr> {
    let failed = |error: mdns_sd::Error| io::Error::other(format!("cannot look up {name} by multicast DNS: {error}"));
    let daemon = ServiceDaemon::new().map_err(failed)?;
    let patience = u64::try_from(MULTICAST.as_millis()).unwrap_or(u64::MAX);
    let events = daemon.resolve_hostname(&format!("{name}."), Some(patience)).map_err(failed)?;
    let mut found: Vec<IpAddr> = Vec::new();
    while let Ok(event) = events.recv_async().await {
        match event {
            HostnameResolutionEvent::AddressesFound(_, addresses) => {
                found.extend(addresses.iter().map(mdns_sd::ScopedIp::to_ip_addr));
                if found.iter().any(IpAddr::is_ipv4) {
                    break;
                }
            }
            HostnameResolutionEvent::SearchTimeout(_) | HostnameResolutionEvent::SearchStopped(_) => break,
            _ => {}
        }
    }
    // Ends its thread and sockets, which is not waited for.
    let _ = daemon.shutdown();
    found.sort_by_key(|address| !address.is_ipv4());
    found.into_iter().next().ok_or_else(|| not_found(name, "no host on this network has that name (multicast DNS)"))
}

async fn resolve_dns(name: &str, parsed: Name) -> io::Result<IpAddr> {
    let (config, mut options): (ResolverConfig, ResolverOpts) = read_system_conf().map_err(|error| {
        not_found(name, &format!("it is not in /etc/hosts, and /etc/resolv.conf cannot be used ({error})"))
    })?;
    options.ip_strategy = LookupIpStrategy::Ipv4thenIpv6;
    options.use_hosts_file = ResolveHosts::Never;
    options.timeout = options.timeout.min(ANSWER);
    options.attempts = ATTEMPTS;
    let servers: Vec<String> = config.name_servers().iter().map(|server| server.socket_addr.ip().to_string()).collect();
    let resolver =
        TokioResolver::builder_with_config(config, TokioConnectionProvider::default()).with_options(options).build();
    match resolver.lookup_ip(parsed).await {
        Ok(addresses) => {
            addresses.iter().next().ok_or_else(|| not_found(name, "the DNS servers have no address for it"))
        }
        Err(error) if error.is_nx_domain() || error.is_no_records_found() => {
            let mut servers = servers;
            servers.dedup();
            Err(not_found(name, &format!("asked {}", servers.join(", "))))
        }
        Err(error) => Err(io::Error::other(format!("cannot look up {name}: {error}"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn names_of_this_machine_are_known_without_asking() {
        assert_eq!(resolve("[::1]").await.unwrap(), IpAddr::from(std::net::Ipv6Addr::LOCALHOST));
        assert!(resolve("localhost").await.unwrap().is_loopback());
        assert!(resolve("robot.localhost.").await.unwrap().is_loopback());
    }

    #[tokio::test]
    async fn what_is_no_name_is_told() {
        let error = resolve("a..b").await.unwrap_err();
        assert!(error.to_string().starts_with("a..b: "), "{error}");
    }
}
