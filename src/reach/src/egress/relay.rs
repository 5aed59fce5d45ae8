//! Relays for outgoing connections of a servant. Its network namespace has no route to the outside, so connections of
//! its nodes to a loopback address inside are forwarded from here, each address and port to one host and port.
//! `/etc/hosts` inside maps the host's name to that address, so that programs and certificates see the expected name.

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
use tracing::Instrument;

use super::Route;

/// Maximum number of concurrent connections per route. Each takes two descriptors of the daemon and buffer memory.
const CONNECTIONS: usize = 128;

/// The relays of one servant; closed when dropped.
#[derive(Debug, Default)]
pub struct Relays {
    _listeners: JoinSet<()>,
}

impl Relays {
    /// Opens the relays. One that cannot be opened is logged and left out.
    pub async fn open(network: &NetNs, routes: &[Route]) -> Relays {
        let mut listeners = JoinSet::new();
        for route in routes {
            let inside = SocketAddr::from((route.inside, route.port));
            match network.listen(inside).await {
                Ok(listener) => {
                    let relaying = relay_connections(listener, route.clone());
                    listeners.spawn(relaying.in_current_span());
                }
                Err(error) => {
                    tracing::warn!("no route out to {}:{}: {error}", route.host, route.port)
                }
            }
        }
        Relays { _listeners: listeners }
    }
}

async fn relay_connections(listener: TcpListener, route: Route) {
    let far = Arc::new(RelayTarget { route, told: Mutex::default(), told_full: AtomicBool::new(false) });
    let room = Arc::new(Semaphore::new(CONNECTIONS));
    // Aborted together with the listener.
    let mut connections = JoinSet::new();
    loop {
        tokio::select! {
            accepted = listener.accept() => {
                let Ok((mut near, _)) = accepted else {
                    // Possibly out of descriptors; other connections may end meanwhile.
                    tokio::time::sleep(std::time::Duration::from_millis(100)).await;
                    continue;
                };
                // Nodes understand a refusal; waiting would look like a host that is down.
                let Ok(place) = Arc::clone(&room).try_acquire_owned() else {
                    far.report_full();
                    continue;
                };
                let far = Arc::clone(&far);
                let relaying = async move {
                    let _place = place;
                    let RelayTarget { route, .. } = &*far;
                    match far.dial().await {
                        Ok(mut stream) => {
                            let _ = tokio::io::copy_bidirectional(&mut near, &mut stream).await;
                        }
                        Err(error) => {
                            tracing::debug!("cannot connect to {}:{}: {error}", route.host, route.port);
                        }
                    }
                };
                connections.spawn(relaying.in_current_span());
            }
            Some(_) = connections.join_next() => {}
        }
    }
}

/// The far end of a relay.
struct RelayTarget {
    route: Route,
    /// Addresses whose refusal was logged.
    told: Mutex<BTreeSet<IpAddr>>,
    /// The connection limit was logged.
    told_full: AtomicBool,
}

impl RelayTarget {
    /// Logs once that connections are refused.
    fn report_full(&self) {
        if !self.told_full.swap(true, Ordering::Relaxed) {
            let Route { host, port, .. } = &self.route;
            tracing::warn!(
                "a servant has {CONNECTIONS} connections to {host}:{port}, which is the limit; further ones are closed \
                    until some end"
            );
        }
    }

    /// Resolves the host and connects to the first permitted address that answers. The address that was checked is
    /// dialled; the name is not resolved again.
    async fn dial(&self) -> io::Result<TcpStream> {
        let RelayTarget { route, .. } = self;
        let mut outcome = Err(io::Error::from(io::ErrorKind::AddrNotAvailable));
        for address in tokio::net::lookup_host((route.host.as_str(), route.port)).await? {
            if let Err(reach) = route.permits(address.ip()) {
                if self.told.lock().insert(address.ip()) {
                    tracing::warn!(
                        "a servant's route out to {}:{} leads to {} ({reach}), which is refused; if that is intended, \
                            allow the address in [allow] of the configuration: egress = [\"{address}\"]",
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

    /// Connects through a relay to `host` on the port of a listener on this machine's loopback, and returns what was
    /// received.
    async fn fetch_through_relay(host: &str, rule: impl Fn(u16) -> String) -> String {
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
        let relaying = tokio::spawn(relay_connections(relay, route));
        let mut heard = String::new();
        let mut stream = TcpStream::connect(near).await.expect("relayed");
        let _ = stream.read_to_string(&mut heard).await;
        relaying.abort();
        heard
    }

    #[tokio::test]
    async fn a_wildcard_never_reaches_this_machine() {
        // Another notation of 127.0.0.1 that only the resolver understands.
        for host in ["localhost", "127.1"] {
            assert_eq!(fetch_through_relay(host, |port| format!("*:{port}")).await, "", "{host}");
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
        let relaying = tokio::spawn(relay_connections(relay, route));
        // Reads the first byte of a connection, if there is one.
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
        for (host, named) in [("localhost", "localhost"), ("127.0.0.1", "127.0.0.1"), ("127.0.0.1", "127.0.0.0/8")] {
            let heard = fetch_through_relay(host, |port| format!("{named}:{port}")).await;
            assert_eq!(heard, "of the host", "{host} by {named}");
        }
    }
}
