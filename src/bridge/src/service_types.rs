//! The type of each service of the servant: queried once per server.

use std::collections::HashMap;

use parking_lot::Mutex;
use ros::bus::{Bus, BusError, Graph, ServiceType};

/// Cached answers, by service; valid while the same node serves it at the same address.
#[derive(Default)]
pub(crate) struct ServiceTypes {
    known: Mutex<HashMap<String, (ServiceServer, ServiceType)>>,
}

#[derive(Clone, PartialEq)]
struct ServiceServer {
    node: String,
    address: Option<String>,
}

impl ServiceTypes {
    /// Returns the type that the service's server announces.
    pub(crate) async fn find(&self, bus: &dyn Bus, service: &str) -> Result<ServiceType, BusError> {
        let server = find_server(&bus.graph().borrow(), service);
        if let Some(server) = &server
            && let Some((asked, found)) = self.known.lock().get(service)
            && asked == server
        {
            return Ok(found.clone());
        }
        let found = bus.service_type(service).await?;
        if let Some(server) = server {
            let mut known = self.known.lock();
            // Bounded even if thousands of services come and go.
            if known.len() >= 4096 {
                known.clear();
            }
            known.insert(service.to_owned(), (server, found.clone()));
        }
        Ok(found)
    }
}

fn find_server(graph: &Graph, service: &str) -> Option<ServiceServer> {
    let node = graph.services.get(service)?.clone();
    let address = graph.nodes.get(&node).cloned();
    Some(ServiceServer { node, address })
}
