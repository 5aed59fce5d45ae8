//! A network namespace as the place of a participant, and of a bus.

use std::io;
use std::net::SocketAddr;
use std::os::fd::OwnedFd;

use async_trait::async_trait;
use ros::net::Sockets;
use rtps::Place;
use servant::netns::NetNs;
use tokio::net::{TcpListener, TcpStream, UdpSocket};

/// That namespace.
pub(crate) struct Within(pub(crate) NetNs);

#[async_trait]
impl Place for Within {
    async fn datagrams(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket> {
        self.0.datagrams(address, shared).await
    }

    async fn diagnostics(&self) -> io::Result<Option<OwnedFd>> {
        self.0.diagnostics().await.map(Some)
    }
}

/// As a daemon's are in a servant.
#[async_trait]
impl Sockets for Within {
    async fn connect(&self, address: SocketAddr) -> io::Result<TcpStream> {
        self.0.connect(address).await
    }

    async fn listen(&self, address: SocketAddr) -> io::Result<TcpListener> {
        self.0.listen(address).await
    }

    async fn datagrams(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket> {
        self.0.datagrams(address, shared).await
    }

    async fn diagnostics(&self) -> io::Result<Option<OwnedFd>> {
        self.0.diagnostics().await.map(Some)
    }
}
