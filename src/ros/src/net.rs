//! Where sockets come from. A servant has a network namespace of its own with nothing but `lo`; the host
//! side reaches its nodes by making sockets *inside* that namespace and using them outside.

use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use async_trait::async_trait;
use tokio::net::{TcpListener, TcpStream};

/// A place in which TCP sockets can be opened: a servant's network namespace, or the host's own.
#[async_trait]
pub trait Sockets: Send + Sync + 'static {
    /// Connects to `address` as seen from inside. `TCP_NODELAY` is set.
    async fn connect(&self, address: SocketAddr) -> io::Result<TcpStream>;
    /// Listens on `address` as seen from inside; port 0 picks a free one.
    async fn listen(&self, address: SocketAddr) -> io::Result<TcpListener>;
    /// Finds the address of a host name as seen from inside. Unless said otherwise the place has nothing but
    /// `lo`: every name there means loopback, and no resolver of the host is ever asked.
    async fn resolve(&self, host: &str, port: u16) -> io::Result<SocketAddr> {
        let ip = literal(host).unwrap_or(IpAddr::V4(Ipv4Addr::LOCALHOST));
        Ok(SocketAddr::new(ip, port))
    }
}

/// The address that `host` already is, without asking anybody.
fn literal(host: &str) -> Option<IpAddr> {
    let bare = host
        .strip_prefix('[')
        .and_then(|rest| rest.strip_suffix(']'))
        .unwrap_or(host);
    if bare.eq_ignore_ascii_case("localhost") {
        return Some(IpAddr::V4(Ipv4Addr::LOCALHOST));
    }
    bare.parse().ok()
}

/// The network namespace of this process: for tests, and for the robot's side of a link.
#[derive(Debug, Clone, Copy, Default)]
pub struct HostSockets;

#[async_trait]
impl Sockets for HostSockets {
    async fn connect(&self, address: SocketAddr) -> io::Result<TcpStream> {
        let stream = TcpStream::connect(address).await?;
        stream.set_nodelay(true)?;
        Ok(stream)
    }

    async fn listen(&self, address: SocketAddr) -> io::Result<TcpListener> {
        TcpListener::bind(address).await
    }

    async fn resolve(&self, host: &str, port: u16) -> io::Result<SocketAddr> {
        if let Some(ip) = literal(host) {
            return Ok(SocketAddr::new(ip, port));
        }
        // ROS 1 nodes listen on IPv4 unless told otherwise.
        let mut found: Vec<SocketAddr> = tokio::net::lookup_host((host, port)).await?.collect();
        found.sort_by_key(|address| !address.is_ipv4());
        found.into_iter().next().ok_or_else(|| {
            io::Error::new(
                io::ErrorKind::NotFound,
                format!("host {host} has no address"),
            )
        })
    }
}

/// The network namespace of this process where that has nothing but `lo`: every host name means loopback.
#[derive(Debug, Clone, Copy, Default)]
pub struct LoopbackSockets;

#[async_trait]
impl Sockets for LoopbackSockets {
    async fn connect(&self, address: SocketAddr) -> io::Result<TcpStream> {
        HostSockets.connect(address).await
    }

    async fn listen(&self, address: SocketAddr) -> io::Result<TcpListener> {
        HostSockets.listen(address).await
    }
}
