//! Which type each service of the servant has: asked once per server.

use std::collections::HashMap;

use parking_lot::Mutex;
use ros::bus::{Bus, BusError, Graph, ServiceType};

/// Answers kept, by service; valid while the same node serves it at the same address.
#[derive(Default)]
pub(crate) struct ServiceTypes {
    known: Mutex<HashMap<String, (Server, ServiceType)>>,
}

#[derive(Clone, PartialEq)]
struct Server {
    node: String,
    address: Option<String>,
}

impl ServiceTypes {
    /// The type that the service's server announces.
    pub(crate) async fn find(&self, bus: &dyn Bus, service: &str) -> Result<ServiceType, BusError> {
        let server = server_of(&bus.graph().borrow(), service);
        if let Some(server) = &server
            && let Some((asked, found)) = self.known.lock().get(service)
            && asked == server
        {
            return Ok(found.clone());
        }
        let found = bus.service_type(service).await?;
        if let Some(server) = server {
            let mut known = self.known.lock();
            // Bounded even where services come and go by the thousand.
            if known.len() >= 4096 {
                known.clear();
            }
            known.insert(service.to_owned(), (server, found.clone()));
        }
        Ok(found)
    }
}

fn server_of(graph: &Graph, service: &str) -> Option<Server> {
    let node = graph.services.get(service)?.clone();
    let address = graph.nodes.get(&node).cloned();
    Some(Server { node, address })
}
