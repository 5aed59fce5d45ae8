//! Ways out of a servant: no route leads out of its namespace, so what its nodes connect to at a loopback address inside is
//! passed on from here, to one host and one port each. `/etc/hosts` inside gives that address the host's name, so
//! that programs, and certificates, find what they expect.

use std::net::SocketAddr;

use api::Grants;
use servant::endpoint::Endpoint;
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;

use super::ways_out;
use crate::config::Allow;

/// The ways out of one servant; closed when dropped.
#[derive(Debug, Default)]
pub struct Relays {
    _listeners: JoinSet<()>,
}

impl Relays {
    /// Opens them. One that cannot be opened is told, and missing.
    pub async fn open(endpoint: &Endpoint, grants: &Grants, allow: &Allow) -> Relays {
        let mut listeners = JoinSet::new();
        // Not allowed any more: then the servant would not have been started either.
        for (host, address, port) in ways_out(grants, allow).unwrap_or_default() {
            let inside = SocketAddr::from((address, port));
            match endpoint.netns.listen(inside).await {
                Ok(listener) => {
                    listeners.spawn(pass_on(listener, host, port));
                }
                Err(error) => tracing::warn!("no way out to {host}:{port}: {error}"),
            }
        }
        Relays {
            _listeners: listeners,
        }
    }
}

async fn pass_on(listener: TcpListener, host: String, port: u16) {
    // Ended with the listener.
    let mut connections = JoinSet::new();
    loop {
        tokio::select! {
            accepted = listener.accept() => {
                let Ok((mut near, _)) = accepted else {
                    // Out of descriptors, perhaps: others may end meanwhile.
                    tokio::time::sleep(std::time::Duration::from_millis(100)).await;
                    continue;
                };
                let host = host.clone();
                connections.spawn(async move {
                    match TcpStream::connect((host.as_str(), port)).await {
                        Ok(mut far) => {
                            let _ = tokio::io::copy_bidirectional(&mut near, &mut far).await;
                        }
                        Err(error) => tracing::debug!("{host}:{port} was not reached: {error}"),
                    }
                });
            }
            Some(_) = connections.join_next() => {}
        }
    }
}
