//! Calls to services of other nodes, over persistent connections that are kept between calls.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use parking_lot::Mutex;
use tokio::sync::watch;
use tokio::time::timeout;

use super::link::broken;
use super::registrar::Kind;
use super::services::LABEL;
use super::{HANDSHAKE, Inner};
use crate::bus::{BusError, CallFate, Digest, Graph, ServiceProvider, ServiceType};
use crate::ros1::names::PeerUri;
use crate::ros1::tcpros::{CallError, Error, Header, ServiceConnection};

/// Connections kept per service while nobody calls.
const MAX_IDLE: usize = 8;

/// Idle connections, by service.
#[derive(Default)]
pub(super) struct CallPool {
    idle: Mutex<HashMap<String, Vec<IdleConnection>>>,
}

/// A connection, and the address of its server's node when it was made, where the graph showed that.
struct IdleConnection {
    connection: ServiceConnection,
    address: Option<String>,
}

impl IdleConnection {
    /// Whether whom it leads to still serves.
    fn is_current(&self, service: &str, graph: &Graph) -> bool {
        let Some(server) = graph.services.get(service) else {
            // What is lent is not in the graph; what was there and is no more is not served.
            return self.address.is_none() && !self.connection.is_stale();
        };
        let said = self.connection.header().get("callerid");
        let same_node = said.is_none_or(|name| name == server);
        // A node of the same name may have taken its place.
        let address = graph.nodes.get(server);
        let same_place = match (&self.address, address) {
            (Some(then), Some(now)) => then == now,
            _ => true,
        };
        same_node && same_place && !self.connection.is_stale()
    }
}

impl CallPool {
    /// A connection that the server has not closed, to whom serves now.
    fn take(&self, service: &str, graph: &watch::Sender<Arc<Graph>>) -> Option<IdleConnection> {
        let mut idle = self.idle.lock();
        let connections = idle.get_mut(service)?;
        while let Some(kept) = connections.pop() {
            if kept.is_current(service, &graph.borrow()) {
                return Some(kept);
            }
        }
        None
    }

    /// Keeps a connection for the next call, unless somebody else has come to serve during this one.
    fn put(&self, service: &str, kept: IdleConnection, graph: &watch::Sender<Arc<Graph>>) {
        let mut idle = self.idle.lock();
        if !kept.is_current(service, &graph.borrow()) {
            return;
        }
        let connections = idle.entry(service.to_owned()).or_default();
        if connections.len() < MAX_IDLE {
            connections.push(kept);
        }
    }

    /// Drops connections to nodes that no longer serve what they were called for.
    pub(super) fn keep_current(&self, graph: &Graph) {
        self.idle.lock().retain(|service, connections| {
            if !graph.services.contains_key(service) {
                return false;
            }
            connections.retain(|kept| kept.is_current(service, graph));
            !connections.is_empty()
        });
    }

    pub(super) fn clear(&self) {
        self.idle.lock().clear();
    }
}

/// Calls once. Tried again only where the server had closed a kept connection before it took the request. A server
/// that says to have another md5 than this one is not asked.
pub(super) async fn call(
    bus: &Arc<Inner>,
    service: &str,
    digest: &Digest,
    request: Bytes,
    time: Duration,
) -> Result<Bytes, BusError> {
    let called = timeout(time, async {
        loop {
            let kept = bus.calls.take(service, &bus.graph);
            let reused = kept.is_some();
            let mut kept = match kept {
                Some(kept) => kept,
                None => {
                    let connection = open(bus, service, ("persistent", "1")).await?;
                    let said = connection.header().get("callerid");
                    let address = said.and_then(|node| bus.graph.borrow().nodes.get(node).cloned());
                    IdleConnection {
                        connection,
                        address,
                    }
                }
            };
            same_type(service, digest, kept.connection.header())?;
            match kept.connection.call(request.clone()).await {
                Ok(answer) => {
                    bus.calls.put(service, kept, &bus.graph);
                    return answer.map_err(|reason| BusError::CallFailed {
                        service: service.to_owned(),
                        reason,
                        fate: CallFate::Answered,
                    });
                }
                Err(CallError::NotTaken) if reused => {}
                Err(CallError::Broken(error)) if !matches!(error, Error::Io(_)) => {
                    return Err(broken(service, error));
                }
                Err(error) => {
                    let fate = match error {
                        CallError::NotTaken => CallFate::NotTaken,
                        _ => CallFate::Unknown,
                    };
                    return Err(BusError::CallFailed {
                        service: service.to_owned(),
                        reason: error.to_string(),
                        fate,
                    });
                }
            }
        }
    });
    called.await.unwrap_or_else(|_| {
        Err(BusError::Timeout {
            what: format!("service {service}"),
            after: time,
        })
    })
}

fn same_type(service: &str, ours: &Digest, header: &Header) -> Result<(), BusError> {
    let theirs = Digest::from(header.get("md5sum").unwrap_or("*"));
    if theirs.agrees(ours) {
        return Ok(());
    }
    Err(BusError::TypeMismatch {
        what: format!("service {service}"),
        theirs: format!("{} {theirs}", header.get("type").unwrap_or("*")),
        ours: ours.to_string(),
    })
}

/// Asks a server for its type, and who it is.
pub(super) async fn probe(bus: &Arc<Inner>, service: &str) -> Result<ServiceProvider, BusError> {
    let own = bus.services.lock().get(service).cloned();
    if let Some(served) = own {
        // Who is told the type may call: the Master must know the server by then.
        bus.registrar.sync(Kind::Service, service, false).await?;
        return Ok(ServiceProvider {
            node: bus.node.clone(),
            service_type: served.service_type.clone(),
            label: bus.label.get().cloned(),
        });
    }
    let connection = open(bus, service, ("probe", "1")).await?;
    let header = connection.header();
    match (header.get("type"), header.get("md5sum")) {
        (Some(name), Some(md5)) => Ok(ServiceProvider {
            node: header.get("callerid").unwrap_or_default().to_owned(),
            service_type: ServiceType::new(name, md5),
            label: header.get(LABEL).map(str::to_owned),
        }),
        _ => Err(BusError::Protocol {
            what: format!("server of {service}"),
            reason: "its header has no type and md5sum".to_owned(),
        }),
    }
}

async fn open(
    bus: &Inner,
    service: &str,
    (purpose, flag): (&str, &str),
) -> Result<ServiceConnection, BusError> {
    let found = bus
        .master
        .ask("lookupService", vec![service.into()])
        .await?;
    let uri = match &found {
        Ok(value) => value.as_str().unwrap_or_default(),
        Err(_) => return Err(BusError::NoService(service.to_owned())),
    };
    let what = || format!("service {service} at {uri}");
    let place = PeerUri::parse(uri, "rosrpc").ok_or_else(|| BusError::Protocol {
        what: what(),
        reason: "its address should look like rosrpc://host:port".to_owned(),
    })?;
    let header = Header::new([
        ("callerid", bus.node.as_str()),
        ("service", service),
        ("md5sum", "*"),
    ])
    .with(purpose, flag);
    let opening = async {
        let resolved = bus.sockets.resolve(&place.host, place.port).await;
        let address = resolved.map_err(Error::Io)?;
        ServiceConnection::open(&*bus.sockets, address, &header, bus.frames.clone()).await
    };
    match timeout(HANDSHAKE, opening).await {
        Ok(Ok(connection)) => Ok(connection),
        Ok(Err(Error::Refused(reason))) => Err(BusError::CallFailed {
            service: service.to_owned(),
            reason,
            fate: CallFate::NotTaken,
        }),
        Ok(Err(error)) => Err(broken(&what(), error)),
        Err(_) => Err(BusError::Timeout {
            what: what(),
            after: HANDSHAKE,
        }),
    }
}

#[cfg(test)]
mod tests {
    use async_trait::async_trait;

    use super::*;
    use crate::bus::{Bus, ServiceHandler};
    use crate::net::HostSockets;
    use crate::ros1::Ros1Bus;
    use crate::ros1::testing::TestMaster;

    struct Echo;

    #[async_trait]
    impl ServiceHandler for Echo {
        async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, String> {
            Ok(request)
        }
    }

    /// A graph in which this node serves.
    fn served_by(node: &str, address: &str) -> Arc<Graph> {
        Arc::new(Graph {
            services: [("/who".to_owned(), node.to_owned())].into(),
            nodes: [(node.to_owned(), address.to_owned())].into(),
            ..Graph::default()
        })
    }

    #[tokio::test]
    async fn only_a_connection_to_whom_serves_now_is_used_again() {
        let master = TestMaster::start().await;
        let join = |name| Ros1Bus::connect(Arc::new(HostSockets), master.address, name);
        let (server, caller) = (join("/old").await.unwrap(), join("/caller").await.unwrap());
        let service_type = ServiceType::new("pkg/Who", "abcd");
        let _served = server.serve("/who", service_type, Arc::new(Echo)).await;
        let connection = || async {
            let opened = open(&caller.inner, "/who", ("persistent", "1")).await;
            IdleConnection {
                connection: opened.unwrap(),
                address: Some("http://a/".to_owned()),
            }
        };
        let pool = CallPool::default();
        let graph = watch::Sender::new(served_by("/old", "http://a/"));
        pool.put("/who", connection().await, &graph);
        assert!(pool.take("/who", &graph).is_some());

        // Another node takes the service over while the connection is idle, or in use.
        pool.put("/who", connection().await, &graph);
        graph.send_replace(served_by("/new", "http://b/"));
        assert!(pool.take("/who", &graph).is_none());
        pool.put("/who", connection().await, &graph);
        graph.send_replace(served_by("/old", "http://a/"));
        assert!(pool.take("/who", &graph).is_none(), "it was kept");

        // A node of the same name comes back at another place.
        pool.put("/who", connection().await, &graph);
        graph.send_replace(served_by("/old", "http://c/"));
        assert!(pool.take("/who", &graph).is_none());
    }
}
