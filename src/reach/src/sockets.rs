//! Implementation of the ROS socket interface in the network namespace of a servant.

use std::io;
use std::net::SocketAddr;
use std::os::fd::OwnedFd;
use std::sync::Arc;

use async_trait::async_trait;
use servant::netns::NetNs;
use tokio::net::{TcpListener, TcpStream, UdpSocket};

/// Sockets inside one servant.
#[derive(Debug, Clone)]
pub struct ServantSockets {
    netns: Arc<NetNs>,
}

impl ServantSockets {
    /// Creates the sockets of the servant with this namespace.
    pub fn new(netns: &Arc<NetNs>) -> ServantSockets {
        ServantSockets { netns: Arc::clone(netns) }
    }
}

#[async_trait]
impl ros::net::Sockets for ServantSockets {
    async fn connect(&self, address: SocketAddr) -> io::Result<TcpStream> {
        self.netns.connect(address).await
    }

    async fn listen(&self, address: SocketAddr) -> io::Result<TcpListener> {
        self.netns.listen(address).await
    }

    async fn bind_udp(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket> {
        self.netns.bind_udp(address, shared).await
    }

    async fn open_sock_diag(&self) -> io::Result<Option<OwnedFd>> {
        self.netns.open_sock_diag().await.map(Some)
    }
}
