//! Calls to services of other nodes, over persistent connections that are kept between calls.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use ros_bus::{BusError, CallFate, Digest, Graph, ServiceProvider, ServiceType};
use tokio::sync::watch;
use tokio::time::timeout;

use super::link::from_tcpros_error;
use super::registrar::Kind;
use super::services::LABEL;
use super::state::{CallPool, HANDSHAKE, IdleConnection, Ros1BusState};
use crate::names::PeerUri;
use crate::tcpros::{CallError, Error, Header, ServiceConnection};

/// Maximum number of idle connections per service.
const MAX_IDLE: usize = 8;

impl IdleConnection {
    /// Returns true if the connection's server still serves the service.
    fn is_current(&self, service: &str, graph: &Graph) -> bool {
        let Some(server) = graph.services.get(service) else {
            // Lent services are not in the graph; a service that was in it and is missing now is not served.
            return self.address.is_none() && !self.connection.is_stale();
        };
        let said = self.connection.header().get("callerid");
        let same_node = said.is_none_or(|name| name == server);
        // Another node of the same name may have replaced it.
        let address = graph.nodes.get(server);
        let same_place = match (&self.address, address) {
            (Some(then), Some(now)) => then == now,
            _ => true,
        };
        same_node && same_place && !self.connection.is_stale()
    }
}

impl CallPool {
    /// Takes a connection that the server has not closed, to the current server.
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

    /// Keeps a connection for the next call, unless the server was replaced during this one.
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

    /// Drops connections to nodes that no longer serve their service.
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

/// Calls a service once. Retries only if the server had closed a kept connection before it took the request. Fails
/// without sending the request if the server declares another md5 than `digest`.
pub(super) async fn call(
    bus: &Arc<Ros1BusState>,
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
                    let connection = open_connection(bus, service, ("persistent", "1")).await?;
                    let said = connection.header().get("callerid");
                    let address = said.and_then(|node| bus.graph.borrow().nodes.get(node).cloned());
                    IdleConnection { connection, address }
                }
            };
            check_type(service, digest, kept.connection.header())?;
            match kept.connection.call(request.clone()).await {
                Ok(answer) => {
                    bus.calls.put(service, kept, &bus.graph);
                    return answer.map_err(|reason| BusError::CallFailed {
                        service: service.to_owned(),
                        reason: reason.into_string(),
                        fate: CallFate::Answered,
                    });
                }
                Err(CallError::NotTaken) if reused => {}
                Err(CallError::Broken(error)) if !matches!(error, Error::Io(_)) => {
                    return Err(from_tcpros_error(service, error));
                }
                Err(error) => {
                    let fate = match error {
                        CallError::NotTaken => CallFate::NotTaken,
                        _ => CallFate::Unknown,
                    };
                    return Err(BusError::CallFailed { service: service.to_owned(), reason: error.to_string(), fate });
                }
            }
        }
    });
    called.await.unwrap_or_else(|_| Err(BusError::Timeout { what: format!("service {service}"), after: time }))
}

fn check_type(service: &str, ours: &Digest, header: &Header) -> Result<(), BusError> {
    let theirs = Digest::from(header.get("md5sum").unwrap_or("*"));
    if theirs.is_compatible_with(ours) {
        return Ok(());
    }
    Err(BusError::TypeMismatch {
        what: format!("service {service}"),
        theirs: format!("{} {theirs}", header.get("type").unwrap_or("*")),
        ours: ours.to_string(),
    })
}

/// Asks a server for its type and identity.
pub(super) async fn probe(bus: &Arc<Ros1BusState>, service: &str) -> Result<ServiceProvider, BusError> {
    let own = bus.services.lock().get(service).cloned();
    if let Some(served) = own {
        // A node that is told the type may call: the Master must know the server by then.
        bus.registrar.sync(Kind::Service, service, false).await?;
        return Ok(ServiceProvider {
            node: bus.node.clone(),
            service_type: served.service_type.clone(),
            label: bus.label.get().cloned(),
        });
    }
    let connection = open_connection(bus, service, ("probe", "1")).await?;
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

async fn open_connection(
    bus: &Ros1BusState,
    service: &str,
    (purpose, flag): (&str, &str),
) -> Result<ServiceConnection, BusError> {
    let found = bus.master.ask("lookupService", vec![service.into()]).await?;
    let uri = match &found {
        Ok(value) => value.as_str().unwrap_or_default(),
        Err(_) => return Err(BusError::NoService(service.to_owned())),
    };
    let what = || format!("service {service} at {uri}");
    let place = PeerUri::parse(uri, "rosrpc").ok_or_else(|| BusError::Protocol {
        what: what(),
        reason: "its address should look like rosrpc://host:port".to_owned(),
    })?;
    let header =
        Header::new([("callerid", bus.node.as_str()), ("service", service), ("md5sum", "*")]).with_field(purpose, flag);
    let opening = async {
        let resolved = bus.sockets.resolve(&place.host, place.port).await;
        let address = resolved.map_err(Error::Io)?;
        ServiceConnection::open(&*bus.sockets, address, &header, bus.frames.clone()).await
    };
    match timeout(HANDSHAKE, opening).await {
        Ok(Ok(connection)) => Ok(connection),
        Ok(Err(Error::Refused(reason))) => {
            Err(BusError::CallFailed { service: service.to_owned(), reason, fate: CallFate::NotTaken })
        }
        Ok(Err(error)) => Err(from_tcpros_error(&what(), error)),
        Err(_) => Err(BusError::Timeout { what: what(), after: HANDSHAKE }),
    }
}

#[cfg(test)]
mod tests {
    use async_trait::async_trait;
    use ros_bus::net::HostSockets;
    use ros_bus::{Bus, FailureReason, ServiceHandler};

    use super::*;
    use crate::Ros1Bus;
    use crate::testing::TestMaster;

    struct Echo;

    #[async_trait]
    impl ServiceHandler for Echo {
        async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
            Ok(request)
        }
    }

    /// A graph in which this node serves.
    fn graph_with_server(node: &str, address: &str) -> Arc<Graph> {
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
            let opened = open_connection(&caller.inner, "/who", ("persistent", "1")).await;
            IdleConnection { connection: opened.unwrap(), address: Some("http://a/".to_owned()) }
        };
        let pool = CallPool::default();
        let graph = watch::Sender::new(graph_with_server("/old", "http://a/"));
        pool.put("/who", connection().await, &graph);
        assert!(pool.take("/who", &graph).is_some());

        // Another node takes over the service while the connection is idle, or in use.
        pool.put("/who", connection().await, &graph);
        graph.send_replace(graph_with_server("/new", "http://b/"));
        assert!(pool.take("/who", &graph).is_none());
        pool.put("/who", connection().await, &graph);
        graph.send_replace(graph_with_server("/old", "http://a/"));
        assert!(pool.take("/who", &graph).is_none(), "it was kept");

        // A node of the same name returns at another address.
        pool.put("/who", connection().await, &graph);
        graph.send_replace(graph_with_server("/old", "http://c/"));
        assert!(pool.take("/who", &graph).is_none());
    }
}
