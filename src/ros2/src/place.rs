//! Sockets and discovery settings of a participant, taken from those of a bus.

use std::io;
use std::net::SocketAddr;
use std::os::fd::OwnedFd;
use std::sync::Arc;

use async_trait::async_trait;
use ros_bus::net::Sockets;
use ros_bus::{DiscoveryNetwork, InterfaceSelection};
use rtps::{Config, DiscoveryServer, InterfaceAddress};
use tokio::net::UdpSocket;

/// Adapter of a bus's sockets.
pub(super) struct BusSockets(pub(super) Arc<dyn Sockets>);

#[async_trait]
impl rtps::NetworkNamespace for BusSockets {
    async fn bind_udp(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket> {
        self.0.bind_udp(address, shared).await
    }

    async fn interfaces(&self) -> io::Result<Vec<InterfaceAddress>> {
        let found = self.0.interfaces().await?.into_iter();
        let converted = found.map(|it| InterfaceAddress { address: it.address, prefix: it.prefix });
        Ok(converted.collect())
    }

    async fn open_diagnostics(&self) -> io::Result<Option<OwnedFd>> {
        self.0.open_sock_diag().await
    }
}

/// Returns the configuration with these discovery settings.
pub(super) fn with_network(config: Config, network: DiscoveryNetwork) -> Config {
    let servers = network.servers.into_iter();
    Config {
        interfaces: match network.interfaces {
            InterfaceSelection::All => rtps::InterfaceSelection::All,
            InterfaceSelection::These(these) => rtps::InterfaceSelection::These(these),
        },
        multicast: network.multicast,
        alone: network.alone,
        peers: network.peers,
        servers: servers.map(|server| DiscoveryServer { place: server.place, at: server.at }).collect(),
        well_known: network.well_known,
        ..config
    }
}
