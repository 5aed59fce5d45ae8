//! Calls to services: one client per called service, kept for the next call.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use ros_bus::{BusError, Digest, ServiceType};
use tokio::time::timeout;

pub(super) use super::client::ServiceClient;
use super::seen::DiscoverySnapshot;
use super::state::Ros2BusState;
use super::{names, node_ends, services};

/// Time for a service that was just started to be discovered.
pub(super) const GRACE: Duration = Duration::from_millis(300);
/// Maximum number of clients that are kept.
const MAX_CLIENTS: usize = 256;

/// Calls a service once. Fails without sending the request if the server's type is known to have another digest than
/// `digest`.
pub(super) async fn call(
    bus: &Arc<Ros2BusState>,
    service: &str,
    digest: &Digest,
    request: Bytes,
    time: Duration,
) -> Result<Bytes, BusError> {
    let begun = Instant::now();
    let of = find_type(bus, service, time.min(GRACE)).await?;
    // An endpoint announces the hash of its requests; a caller that has only that may pass it.
    if !of.digest.is_compatible_with(digest) && of.request != *digest {
        return Err(BusError::TypeMismatch {
            what: format!("service {service}"),
            theirs: format!("{} {}", of.name, of.digest),
            ours: digest.to_string(),
        });
    }
    let client = client_for(bus, service, &of)?;
    let left = time.saturating_sub(begun.elapsed());
    client.call(request, left).await
}

/// Returns the type of a service according to its server: its name and the hashes that its endpoints announce.
pub(super) async fn find_type(
    bus: &Arc<Ros2BusState>,
    service: &str,
    patience: Duration,
) -> Result<ServiceType, BusError> {
    if let Some(served) = services::local_service(bus, service) {
        return Ok(served.of.clone());
    }
    let mut seen = bus.seen.subscribe();
    let found = timeout(patience, async {
        loop {
            if let Some(found) = served_type(&seen.borrow_and_update(), service) {
                return Ok(found);
            }
            seen.changed().await.map_err(|_| BusError::Closed)?;
        }
    });
    match found.await {
        Ok(found) => found,
        Err(_) => Err(BusError::NoService(service.to_owned())),
    }
}

fn served_type(seen: &DiscoverySnapshot, service: &str) -> Option<ServiceType> {
    let request = seen.readers(&names::request_name(service));
    let mut servers = request.iter();
    servers.find_map(|end| node_ends::service_type(seen, end, service, false))
}

/// Returns the client of a service; there is one per service and type.
pub(super) fn client_for(
    bus: &Arc<Ros2BusState>,
    service: &str,
    of: &ServiceType,
) -> Result<Arc<ServiceClient>, BusError> {
    bus.check_open()?;
    let key = (service.to_owned(), of.name.clone());
    if let Some(known) = bus.clients.lock().get(&key) {
        return Ok(Arc::clone(known));
    }
    let made = Arc::new(ServiceClient::open(bus, service, of)?);
    let mut idle = Vec::new();
    let mut clients = bus.clients.lock();
    if clients.len() >= MAX_CLIENTS {
        idle.extend(clients.extract_idle(|_, _| true));
    }
    let kept = Arc::clone(clients.entry(key).or_insert(made));
    // Dropping a client withdraws its endpoints, so it happens outside the lock.
    drop(clients);
    drop(idle);
    Ok(kept)
}

/// Drops clients of services that no node serves any more.
pub(super) fn drop_unserved_clients(bus: &Ros2BusState, seen: &DiscoverySnapshot) {
    let idle: Vec<Arc<ServiceClient>> =
        bus.clients.lock().extract_idle(|service, _| seen.readers(&names::request_name(service)).is_empty());
    drop(idle);
}

trait ExtractIdle {
    fn extract_idle(&mut self, wanted: impl Fn(&str, &ServiceClient) -> bool) -> Vec<Arc<ServiceClient>>;
}

impl ExtractIdle for HashMap<(String, String), Arc<ServiceClient>> {
    /// Takes out those that are not in use.
    fn extract_idle(&mut self, wanted: impl Fn(&str, &ServiceClient) -> bool) -> Vec<Arc<ServiceClient>> {
        let mut taken = Vec::new();
        self.retain(|(service, _), client| {
            let idle = Arc::strong_count(client) == 1 && wanted(service, client);
            if idle {
                taken.push(Arc::clone(client));
            }
            !idle
        });
        taken
    }
}
