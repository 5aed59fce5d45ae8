//! Sockets of a participant, taken from the sockets of a bus.

use std::io;
use std::net::SocketAddr;
use std::os::fd::OwnedFd;
use std::sync::Arc;

use async_trait::async_trait;
use rtps::InterfaceAddress;
use tokio::net::UdpSocket;

use crate::net::Sockets;

/// Adapter of a bus's sockets.
pub(super) struct BusSockets(pub(super) Arc<dyn Sockets>);

#[async_trait]
impl rtps::NetworkNamespace for BusSockets {
    async fn bind_udp(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket> {
        self.0.bind_udp(address, shared).await
    }

    async fn interfaces(&self) -> io::Result<Vec<InterfaceAddress>> {
        self.0.interfaces().await
    }

    async fn open_diagnostics(&self) -> io::Result<Option<OwnedFd>> {
        self.0.open_sock_diag().await
    }
}
