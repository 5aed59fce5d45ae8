//! Ways out of a servant: no route leads out of its namespace, so what its nodes connect to at a loopback address inside is
//! passed on from here, to one host and one port each. `/etc/hosts` inside gives that address the host's name, so
//! that programs, and certificates, find what they expect.

use std::collections::BTreeSet;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use parking_lot::Mutex;
use servant::netns::NetNs;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::task::JoinSet;

use super::Route;

/// Connections at a time through one way out. Each takes two descriptors of the daemon, and memory for what is passed on.
const CONNECTIONS: usize = 128;

/// The routes out of one servant; closed when dropped.
#[derive(Debug, Default)]
pub struct Relays {
    _listeners: JoinSet<()>,
}

impl Relays {
    /// Opens them. One that cannot be opened is told, and missing.
    pub async fn open(network: &NetNs, routes: &[Route]) -> Relays {
        let mut listeners = JoinSet::new();
        for route in routes {
            let inside = SocketAddr::from((route.inside, route.port));
            match network.listen(inside).await {
                Ok(listener) => {
                    listeners.spawn(pass_on(listener, route.clone()));
                }
                Err(error) => {
                    tracing::warn!("no route out to {}:{}: {error}", route.host, route.port)
                }
            }
        }
        Relays {
            _listeners: listeners,
        }
    }
}

async fn pass_on(listener: TcpListener, route: Route) {
    let far = Arc::new(Far {
        route,
        told: Mutex::default(),
        told_full: AtomicBool::new(false),
    });
    let room = Arc::new(Semaphore::new(CONNECTIONS));
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
                // A refusal is what a node understands; to wait would look like a host that is down.
                let Ok(place) = Arc::clone(&room).try_acquire_owned() else {
                    far.report_full();
                    continue;
                };
                let far = Arc::clone(&far);
                connections.spawn(async move {
                    let _place = place;
                    let Far { route, .. } = &*far;
                    match far.dial().await {
                        Ok(mut stream) => {
                            let _ = tokio::io::copy_bidirectional(&mut near, &mut stream).await;
                        }
                        Err(error) => {
                            tracing::debug!("{}:{} was not reached: {error}", route.host, route.port);
                        }
                    }
                });
            }
            Some(_) = connections.join_next() => {}
        }
    }
}

/// The far end of a way out.
struct Far {
    route: Route,
    /// Addresses whose refusal was told.
    told: Mutex<BTreeSet<IpAddr>>,
    /// Whether it was told that there were too many connections.
    told_full: AtomicBool,
}

impl Far {
    /// Tells, once, that connections are refused.
    fn report_full(&self) {
        if !self.told_full.swap(true, Ordering::Relaxed) {
            let Route { host, port, .. } = &self.route;
            tracing::warn!(
                "a servant has {CONNECTIONS} connections to {host}:{port}, as many as may be; further ones are closed until some end"
            );
        }
    }

    /// Resolves the host and connects to the first of its addresses that may be dialled and answers. What is dialled is
    /// the address that was looked at: the name is not resolved again.
    async fn dial(&self) -> io::Result<TcpStream> {
        let Far { route, .. } = self;
        let mut outcome = Err(io::Error::from(io::ErrorKind::AddrNotAvailable));
        for address in tokio::net::lookup_host((route.host.as_str(), route.port)).await? {
            if let Err(reach) = route.permits(address.ip()) {
                if self.told.lock().insert(address.ip()) {
                    tracing::warn!(
                        "a servant's route out to {}:{} leads to {} ({reach}) and is refused there; if that is meant, name \
                         the address in [allow] of the configuration: egress = [\"{address}\"]",
                        route.host,
                        route.port,
                        address.ip()
                    );
                }
                outcome = Err(io::Error::from(io::ErrorKind::PermissionDenied));
                continue;
            }
            match TcpStream::connect(address).await {
                Ok(stream) => return Ok(stream),
                Err(error) => outcome = Err(error),
            }
        }
        outcome
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    use super::super::routes;
    use super::*;

    /// Asks `host` on the port of a listener of this machine's loopback, through a relay; what came back.
    async fn asks(host: &str, rule: impl Fn(u16) -> String) -> String {
        let server = TcpListener::bind("127.0.0.1:0").await.expect("bound");
        let port = server.local_addr().expect("bound").port();
        tokio::spawn(async move {
            while let Ok((mut stream, _)) = server.accept().await {
                let _ = stream.write_all(b"of the host").await;
            }
        });
        let asked = [format!("{host}:{port}")];
        let route = routes(&asked, &[rule(port)]).expect("allowed").remove(0);
        let relay = TcpListener::bind("127.0.0.1:0").await.expect("bound");
        let near = relay.local_addr().expect("bound");
        let relaying = tokio::spawn(pass_on(relay, route));
        let mut heard = String::new();
        let mut stream = TcpStream::connect(near).await.expect("relayed");
        let _ = stream.read_to_string(&mut heard).await;
        relaying.abort();
        heard
    }

    #[tokio::test]
    async fn any_host_is_none_of_this_machine() {
        // Another way to write 127.0.0.1, which only the resolver understands.
        for host in ["localhost", "127.1"] {
            assert_eq!(asks(host, |port| format!("*:{port}")).await, "", "{host}");
        }
    }

    #[tokio::test]
    async fn connections_beyond_the_limit_are_closed_until_others_end() {
        let server = TcpListener::bind("127.0.0.1:0").await.expect("bound");
        let port = server.local_addr().expect("bound").port();
        tokio::spawn(async move {
            while let Ok((mut stream, _)) = server.accept().await {
                tokio::spawn(async move {
                    let _ = stream.write_all(b"x").await;
                    // Until the other side has closed.
                    let _ = stream.read_to_end(&mut Vec::new()).await;
                });
            }
        });
        let egress = vec![format!("127.0.0.1:{port}")];
        let route = routes(&egress, &egress).expect("allowed").remove(0);
        let relay = TcpListener::bind("127.0.0.1:0").await.expect("bound");
        let near = relay.local_addr().expect("bound");
        let relaying = tokio::spawn(pass_on(relay, route));
        // What the first byte of a connection is, if it has one.
        let first = async || {
            let mut stream = TcpStream::connect(near).await.expect("accepted");
            let mut byte = [0];
            let read = stream.read(&mut byte).await;
            read.is_ok_and(|read| read == 1).then_some(stream)
        };
        let mut open = Vec::new();
        for _ in 0..CONNECTIONS {
            open.push(first().await.expect("there is room"));
        }
        assert!(first().await.is_none(), "one too many");
        drop(open);
        while first().await.is_none() {}
        relaying.abort();
    }

    #[tokio::test]
    async fn this_machine_is_reached_where_it_is_named() {
        for (host, named) in [
            ("localhost", "localhost"),
            ("127.0.0.1", "127.0.0.1"),
            ("127.0.0.1", "127.0.0.0/8"),
        ] {
            let heard = asks(host, |port| format!("{named}:{port}")).await;
            assert_eq!(heard, "of the host", "{host} by {named}");
        }
    }
}
