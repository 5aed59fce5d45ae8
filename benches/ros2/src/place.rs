//! A network namespace as the network of a participant and of a bus.

use std::io;
use std::net::SocketAddr;
use std::os::fd::OwnedFd;

use async_trait::async_trait;
use ros::net::Sockets;
use rtps::NetworkNamespace;
use servant::netns::NetNs;
use tokio::net::{TcpListener, TcpStream, UdpSocket};

/// Sockets in a network namespace.
pub(crate) struct NamespaceSockets(pub(crate) NetNs);

#[async_trait]
impl NetworkNamespace for NamespaceSockets {
    async fn bind_udp(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket> {
        self.0.bind_udp(address, shared).await
    }

    async fn open_diagnostics(&self) -> io::Result<Option<OwnedFd>> {
        self.0.open_sock_diag().await.map(Some)
    }
}

/// Like the sockets of a daemon in a servant.
#[async_trait]
impl Sockets for NamespaceSockets {
    async fn connect(&self, address: SocketAddr) -> io::Result<TcpStream> {
        self.0.connect(address).await
    }

    async fn listen(&self, address: SocketAddr) -> io::Result<TcpListener> {
        self.0.listen(address).await
    }

    async fn bind_udp(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket> {
        self.0.bind_udp(address, shared).await
    }

    async fn open_sock_diag(&self) -> io::Result<Option<OwnedFd>> {
        self.0.open_sock_diag().await.map(Some)
    }
}
