//! Where a participant has its sockets: where those of a bus come from.

use std::io;
use std::net::SocketAddr;
use std::os::fd::OwnedFd;
use std::sync::Arc;

use async_trait::async_trait;
use rtps::Interface;
use tokio::net::UdpSocket;

use crate::net::Sockets;

/// The place of these sockets.
pub(super) struct Place(pub(super) Arc<dyn Sockets>);

#[async_trait]
impl rtps::Place for Place {
    async fn datagrams(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket> {
        self.0.datagrams(address, shared).await
    }

    async fn interfaces(&self) -> io::Result<Vec<Interface>> {
        self.0.interfaces().await
    }

    async fn diagnostics(&self) -> io::Result<Option<OwnedFd>> {
        self.0.diagnostics().await
    }
}
