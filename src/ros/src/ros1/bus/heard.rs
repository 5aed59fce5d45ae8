//! Whom a topic's publishers send to, as they say themselves (`getBusInfo` of the slave API). A publisher answers a
//! subscriber's header before it sends to it: what it publishes in between, the subscriber does not hear.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use parking_lot::Mutex;

use super::master_client::to_bus_error;
use super::{HANDSHAKE, Inner, Ros1Bus};
use crate::bus::{BusError, Hearing, PeerId};
use crate::ros1::reply::Reply;
use crate::ros1::xmlrpc::{Client, Value};

/// How long the connection to a publisher is kept after it was asked: whoever waits to be heard asks often.
const IDLE_TIMEOUT: Duration = Duration::from_secs(1);

/// Publishers that were asked a moment ago.
#[derive(Default)]
pub(super) struct PublisherClients {
    clients: Mutex<HashMap<String, (Arc<Client>, Instant)>>,
}

impl PublisherClients {
    /// A client of the publisher at `uri`, connected already where it was asked before.
    fn client(&self, bus: &Arc<Inner>, uri: &str) -> Result<Arc<Client>, BusError> {
        let mut clients = self.clients.lock();
        if let Some((client, asked)) = clients.get_mut(uri) {
            *asked = Instant::now();
            return Ok(client.clone());
        }
        let client = Arc::new(bus.client(uri)?);
        if clients.is_empty() {
            bus.spawn(forget(bus.clone()));
        }
        clients.insert(uri.to_owned(), (client.clone(), Instant::now()));
        Ok(client)
    }
}

/// Closes the connections to those that are asked no more, until there is none left.
async fn forget(bus: Arc<Inner>) {
    loop {
        tokio::time::sleep(IDLE_TIMEOUT).await;
        let mut clients = bus.publisher_clients.clients.lock();
        clients.retain(|_, (_, asked)| asked.elapsed() < IDLE_TIMEOUT);
        if clients.is_empty() {
            return;
        }
    }
}

#[async_trait]
impl Hearing for Ros1Bus {
    async fn heard_over(&self, topic: &str) -> Result<BTreeSet<PeerId>, BusError> {
        connections(&self.inner, topic).await
    }
}

/// The connections over which the topic's publishers send to us, as these say.
pub(super) async fn connections(
    bus: &Arc<Inner>,
    topic: &str,
) -> Result<BTreeSet<PeerId>, BusError> {
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
        let rows = Reply::from_value(answer).map(|reply| reply.value);
        let rows = rows.as_ref().and_then(Value::as_array).unwrap_or_default();
        let ours = rows.iter().filter_map(|row| {
            let [Value::Int(id), peer, direction, _, of, ..] = row.as_array()? else {
                return None;
            };
            let ours = peer.as_str() == Some(&bus.node)
                && direction.as_str() == Some("o")
                && of.as_str() == Some(topic);
            ours.then(|| PeerId::new(node.as_str(), id.unsigned_abs().into()))
        });
        found.extend(ours);
    }
    Ok(found)
}
