//! Where sockets come from. A servant has a network namespace of its own with nothing but `lo`; the host
//! side reaches its nodes by making sockets *inside* that namespace and using them outside.

use std::io;
use std::net::SocketAddr;

use async_trait::async_trait;
use tokio::net::{TcpListener, TcpStream};

/// A place in which TCP sockets can be opened: a servant's network namespace, or the host's own.
#[async_trait]
pub trait Sockets: Send + Sync + 'static {
    /// Connects to `address` as seen from inside. `TCP_NODELAY` is set.
    async fn connect(&self, address: SocketAddr) -> io::Result<TcpStream>;
    /// Listens on `address` as seen from inside; port 0 picks a free one.
    async fn listen(&self, address: SocketAddr) -> io::Result<TcpListener>;
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
}
