//! The publishers' own reports about their subscribers (`getBusInfo` of the slave API). A publisher answers a
//! subscriber's header before it sends to it: what it publishes in between never reaches the subscriber.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::{Duration, Instant};

use ros_bus::{BusError, PeerId};

use super::master_client::to_bus_error;
use super::state::{HANDSHAKE, PublisherClients, Ros1BusState};
use crate::reply::ApiReply;
use crate::xmlrpc::{Value, XmlRpcClient};

/// Time for which the connection to a publisher is kept after a query, because a node that waits for its subscription
/// to take effect queries often.
const IDLE_TIMEOUT: Duration = Duration::from_secs(1);

impl PublisherClients {
    /// Returns a client of the publisher at `uri`, already connected if it was queried recently.
    fn client(&self, bus: &Arc<Ros1BusState>, uri: &str) -> Result<Arc<XmlRpcClient>, BusError> {
        let mut clients = self.clients.lock();
        if let Some((client, asked)) = clients.get_mut(uri) {
            *asked = Instant::now();
            return Ok(client.clone());
        }
        let client = Arc::new(bus.client(uri)?);
        if clients.is_empty() {
            bus.spawn(close_idle_clients(bus.clone()));
        }
        clients.insert(uri.to_owned(), (client.clone(), Instant::now()));
        Ok(client)
    }
}

/// Closes the connections that are no longer used, until none is left.
async fn close_idle_clients(bus: Arc<Ros1BusState>) {
    loop {
        tokio::time::sleep(IDLE_TIMEOUT).await;
        let mut clients = bus.publisher_clients.clients.lock();
        clients.retain(|_, (_, asked)| asked.elapsed() < IDLE_TIMEOUT);
        if clients.is_empty() {
            return;
        }
    }
}

/// Returns the connections over which the topic's publishers report that they send to us.
pub(super) async fn connections(bus: &Arc<Ros1BusState>, topic: &str) -> Result<BTreeSet<PeerId>, BusError> {
    let graph = bus.graph.borrow().clone();
    let ends = graph.topics.get(topic);
    let publishers = ends.map(|ends| ends.publishers.clone());
    let mut found = BTreeSet::new();
    for node in publishers.unwrap_or_default() {
        let Some(uri) = graph.nodes.get(&node).filter(|_| node != bus.node) else {
            continue;
        };
        let client = bus.publisher_clients.client(bus, uri)?;
        let caller = [bus.node.as_str().into()];
        let asked = client.call("getBusInfo", &caller, HANDSHAKE);
        let answer = asked.await.map_err(to_bus_error)?;
        let rows = ApiReply::from_value(answer).map(|reply| reply.value);
        let rows = rows.as_ref().and_then(Value::as_array).unwrap_or_default();
        let ours = rows.iter().filter_map(|row| {
            let [Value::Int(id), peer, direction, _, of, ..] = row.as_array()? else {
                return None;
            };
            let ours =
                peer.as_str() == Some(&bus.node) && direction.as_str() == Some("o") && of.as_str() == Some(topic);
            ours.then(|| PeerId::new(node.as_str(), id.unsigned_abs().into()))
        });
        found.extend(ours);
    }
    Ok(found)
}
