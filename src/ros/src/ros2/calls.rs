//! Calls to services: a client of each service that is called, kept for the next call.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use parking_lot::Mutex;
use tokio::time::timeout;

use super::bus::Inner;
pub(super) use super::client::Client;
use super::seen::Seen;
use super::{names, node_ends, services};
use crate::bus::{BusError, Digest, ServiceType};

/// For a service that somebody has just begun to serve to be discovered.
pub(super) const GRACE: Duration = Duration::from_millis(300);
/// Clients that are kept.
const MAX_CLIENTS: usize = 256;

/// Calls once. A server whose type is known to have another digest than this one is not asked.
pub(super) async fn call(
    bus: &Arc<Inner>,
    service: &str,
    digest: &Digest,
    request: Bytes,
    time: Duration,
) -> Result<Bytes, BusError> {
    let begun = Instant::now();
    let of = find(bus, service, time.min(GRACE)).await?;
    // What an end tells is the hash of its requests; whoever has only that may give it.
    if !of.digest.agrees(digest) && of.request != *digest {
        return Err(BusError::TypeMismatch {
            what: format!("service {service}"),
            theirs: format!("{} {}", of.name, of.digest),
            ours: digest.to_string(),
        });
    }
    let client = client(bus, service, &of)?;
    let left = time.saturating_sub(begun.elapsed());
    client.call(request, left).await
}

/// The type of a service by its server: its name and the hashes that its ends tell.
pub(super) async fn find(
    bus: &Arc<Inner>,
    service: &str,
    patience: Duration,
) -> Result<ServiceType, BusError> {
    if let Some(served) = services::here(bus, service) {
        return Ok(served.of.clone());
    }
    let mut seen = bus.seen.subscribe();
    let found = timeout(patience, async {
        loop {
            if let Some(found) = served(&seen.borrow_and_update(), service) {
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

fn served(seen: &Seen, service: &str) -> Option<ServiceType> {
    let request = seen.readers(&names::request_name(service));
    let mut servers = request.iter();
    servers.find_map(|end| node_ends::service_type(seen, end, service, false))
}

/// Clients that are kept, by service and type.
pub(super) type Clients = Mutex<HashMap<(String, String), Arc<Client>>>;

/// The client of a service; of one service and type there is one.
pub(super) fn client(
    bus: &Arc<Inner>,
    service: &str,
    of: &ServiceType,
) -> Result<Arc<Client>, BusError> {
    bus.check_open()?;
    let key = (service.to_owned(), of.name.clone());
    if let Some(known) = bus.clients.lock().get(&key) {
        return Ok(Arc::clone(known));
    }
    let made = Arc::new(Client::open(bus, service, of)?);
    let mut idle = Vec::new();
    let mut clients = bus.clients.lock();
    if clients.len() >= MAX_CLIENTS {
        idle.extend(clients.extract_idle(|_, _| true));
    }
    let kept = Arc::clone(clients.entry(key).or_insert(made));
    // What is dropped withdraws its ends, outside of the lock.
    drop(clients);
    drop(idle);
    Ok(kept)
}

/// Lets go of clients of services that nobody serves any more.
pub(super) fn forget_unserved(bus: &Inner, seen: &Seen) {
    let idle: Vec<Arc<Client>> = bus
        .clients
        .lock()
        .extract_idle(|service, _| seen.readers(&names::request_name(service)).is_empty());
    drop(idle);
}

trait ExtractIdle {
    fn extract_idle(&mut self, wanted: impl Fn(&str, &Client) -> bool) -> Vec<Arc<Client>>;
}

impl ExtractIdle for HashMap<(String, String), Arc<Client>> {
    /// Takes out those that nobody uses.
    fn extract_idle(&mut self, wanted: impl Fn(&str, &Client) -> bool) -> Vec<Arc<Client>> {
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
