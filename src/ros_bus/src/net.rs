//! Sources of sockets. A servant has a network namespace of its own with nothing but `lo`; the host side reaches its
//! nodes by creating sockets *inside* that namespace and using them outside.

use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use socket2::{Domain, Protocol, SockRef, Socket, TcpKeepalive, Type};
use tokio::net::{TcpListener, TcpStream, UdpSocket};
use tokio::sync::Semaphore;
use tokio::task::JoinSet;

use crate::network::InterfaceAddress;
pub use crate::network::list_interfaces;

/// A network namespace in which sockets can be opened: a servant's, or the host's own.
#[async_trait]
pub trait Sockets: Send + Sync + 'static {
    /// Connects to `address` as seen from inside. `TCP_NODELAY` is set.
    async fn connect(&self, address: SocketAddr) -> io::Result<TcpStream>;
    /// Listens on `address` as seen from inside; port 0 picks a free one.
    async fn listen(&self, address: SocketAddr) -> io::Result<TcpListener>;
    /// Resolves a host name as seen from inside. By default the namespace has nothing but `lo`: every name means
    /// loopback, and no resolver of the host is ever asked.
    async fn resolve(&self, host: &str, port: u16) -> io::Result<SocketAddr> {
        let ip = parse_literal(host).unwrap_or(IpAddr::V4(Ipv4Addr::LOCALHOST));
        Ok(SocketAddr::new(ip, port))
    }
    /// Binds a UDP socket to `address` as seen from inside; port 0 picks a free one. With `shared` other sockets may be
    /// bound to the address as well, for multicast.
    async fn bind_udp(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket> {
        let _ = shared;
        let what = format!("no datagrams can be received at {address} here");
        Err(io::Error::new(io::ErrorKind::Unsupported, what))
    }
    /// Returns the interfaces that are up, with their IPv4 addresses. By default there is nothing but `lo`.
    async fn interfaces(&self) -> io::Result<Vec<InterfaceAddress>> {
        Ok(vec![InterfaceAddress::LOOPBACK])
    }
    /// Opens a socket on which the kernel reports the sockets of this namespace (`NETLINK_SOCK_DIAG`, sock_diag(7));
    /// `None` if that is not available.
    async fn open_sock_diag(&self) -> io::Result<Option<OwnedFd>> {
        Ok(None)
    }
}

/// Receive buffer for UDP datagrams in bytes: images may arrive faster than they are read.
const DATAGRAMS: usize = 8 << 20;
/// Constants of netlink(7) and sock_diag(7).
const AF_NETLINK: i32 = 16;
const NETLINK_SOCK_DIAG: i32 = 4;

/// Idle time after which the kernel probes whether a peer is still there.
const KEEPALIVE_IDLE: Duration = Duration::from_secs(20);
/// Interval between unanswered probes.
const KEEPALIVE_INTERVAL: Duration = Duration::from_secs(10);
/// Time without an answer after which a peer counts as gone. It is also the time for which sent data may stay
/// unacknowledged: a peer that does not read for this long loses its connection.
const PEER_TIMEOUT: Duration = Duration::from_secs(60);

/// Makes the kernel end the connection when the peer vanishes silently because its machine lost power or its network.
/// Otherwise a side that only reads would wait forever, and one that writes for a quarter of an hour.
///
/// An idle but live peer is not affected: its kernel answers the probes, even while its process is stopped.
pub fn enable_keepalive(stream: &TcpStream) {
    let socket = SockRef::from(stream);
    let asking = TcpKeepalive::new().with_time(KEEPALIVE_IDLE).with_interval(KEEPALIVE_INTERVAL);
    let asked = socket.set_tcp_keepalive(&asking).and_then(|()| socket.set_tcp_user_timeout(Some(PEER_TIMEOUT)));
    if let Err(error) = asked {
        tracing::debug!(%error, "a peer that disappears silently will not be noticed");
    }
}

/// Accepts connections and serves each in its own task until dropped, which also ends every connection. At most `most`
/// connections are served at a time; further ones wait in the backlog. `what` names the protocol in the log.
pub async fn serve_connections<F, E>(
    listener: TcpListener,
    most: usize,
    what: &'static str,
    serve: impl Fn(TcpStream) -> F,
) where
    F: Future<Output = Result<(), E>> + Send + 'static,
    E: std::fmt::Display,
{
    let places = Arc::new(Semaphore::new(most));
    let mut connections = JoinSet::new();
    loop {
        let Ok(place) = places.clone().acquire_owned().await else {
            return;
        };
        let stream = loop {
            tokio::select! {
                accepted = listener.accept() => match accepted {
                    Ok((stream, _)) => break stream,
                    Err(error) => {
                        // Mostly out of file descriptors: serving must continue once some are free again.
                        tracing::warn!(%error, "cannot accept a connection of {what}");
                        tokio::time::sleep(Duration::from_millis(100)).await;
                    }
                },
                Some(_) = connections.join_next() => {}
            }
        };
        let _ = stream.set_nodelay(true);
        enable_keepalive(&stream);
        let served = serve(stream);
        connections.spawn(async move {
            let _place = place;
            if let Err(error) = served.await {
                tracing::debug!(%error, "a connection of {what} broke");
            }
        });
    }
}

/// Parses `host` as an IP address literal or `localhost`, without any lookup.
fn parse_literal(host: &str) -> Option<IpAddr> {
    let bare = host.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')).unwrap_or(host);
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

    async fn bind_udp(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket> {
        let socket = Socket::new(Domain::for_address(address), Type::DGRAM.nonblocking(), None)?;
        // The kernel caps this at the machine's limit.
        socket.set_recv_buffer_size(DATAGRAMS)?;
        socket.set_reuse_address(shared)?;
        socket.bind(&address.into())?;
        UdpSocket::from_std(socket.into())
    }

    async fn interfaces(&self) -> io::Result<Vec<InterfaceAddress>> {
        list_interfaces()
    }

    async fn open_sock_diag(&self) -> io::Result<Option<OwnedFd>> {
        let (domain, kind) = (Domain::from(AF_NETLINK), Type::RAW.nonblocking().cloexec());
        let socket = Socket::new(domain, kind, Some(Protocol::from(NETLINK_SOCK_DIAG)))?;
        Ok(Some(socket.into()))
    }

    async fn resolve(&self, host: &str, port: u16) -> io::Result<SocketAddr> {
        if let Some(ip) = parse_literal(host) {
            return Ok(SocketAddr::new(ip, port));
        }
        // ROS 1 nodes listen on IPv4 by default.
        let mut found: Vec<SocketAddr> = tokio::net::lookup_host((host, port)).await?.collect();
        found.sort_by_key(|address| !address.is_ipv4());
        found
            .into_iter()
            .next()
            .ok_or_else(|| io::Error::new(io::ErrorKind::NotFound, format!("host {host} has no address")))
    }
}

/// The network namespace of this process if it has nothing but `lo`: every host name means loopback.
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

    async fn bind_udp(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket> {
        HostSockets.bind_udp(address, shared).await
    }

    async fn open_sock_diag(&self) -> io::Result<Option<OwnedFd>> {
        HostSockets.open_sock_diag().await
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn the_host_has_datagrams_and_tells_of_its_sockets() {
        let loopback = || SocketAddr::from(([127, 0, 0, 1], 0));
        let one = HostSockets.bind_udp(loopback(), false).await.unwrap();
        let two = HostSockets.bind_udp(loopback(), false).await.unwrap();
        let address = two.local_addr().unwrap();
        one.send_to(b"hello", address).await.unwrap();
        let mut text = [0; 8];
        assert_eq!(two.recv(&mut text).await.unwrap(), 5);
        assert!(HostSockets.bind_udp(address, false).await.is_err());
        assert!(HostSockets.open_sock_diag().await.unwrap().is_some());
    }

    #[tokio::test]
    async fn a_watched_peer_is_gone_after_a_minute() {
        let listener = HostSockets.listen(SocketAddr::from(([127, 0, 0, 1], 0))).await.unwrap();
        let stream = HostSockets.connect(listener.local_addr().unwrap()).await.unwrap();
        enable_keepalive(&stream);
        let socket = SockRef::from(&stream);
        assert!(socket.keepalive().unwrap());
        assert_eq!(socket.tcp_keepalive_time().unwrap(), KEEPALIVE_IDLE);
        assert_eq!(socket.tcp_keepalive_interval().unwrap(), KEEPALIVE_INTERVAL);
        assert_eq!(socket.tcp_user_timeout().unwrap(), Some(PEER_TIMEOUT));
    }
}
