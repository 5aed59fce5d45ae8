//! A network namespace as the place of a participant.

use std::io;
use std::net::SocketAddr;
use std::os::fd::OwnedFd;

use async_trait::async_trait;
use rtps::Place;
use servant::netns::NetNs;
use tokio::net::UdpSocket;

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
