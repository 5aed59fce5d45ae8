//! Type of a topic, determined from its endpoints, and whether its publisher latches.

use std::sync::Arc;
use std::time::Duration;

use ros_bus::{BusError, Graph, Offer, TopicNodes, WireType};
use tokio::time::timeout;

use super::registrar::Kind;
use super::{Ros1BusState, link, publications, watcher};

/// Time for a topic's subscribers to connect to us and declare their type.
const ANSWER: Duration = Duration::from_secs(3);

/// Returns the type from the first source available: what we advertise, a connection of ours, a publisher's header, the
/// subscribers' requests. If only a name is known (all endpoints accept any md5), the digest is `*`.
pub(super) async fn find(bus: &Arc<Ros1BusState>, name: &str) -> Result<Offer, BusError> {
    let offer = |wire_type, latching| Offer { wire_type: Arc::new(wire_type), latching, kept: None };
    let ours = bus.publications.lock().get(name).cloned();
    if let Some((advert, latching)) = ours.as_ref().and_then(|topic| topic.advert()) {
        return Ok(offer(advert, latching));
    }
    let subscribed = bus.subscriptions.lock().get(name).cloned();
    let links = subscribed.map(|topic| topic.links()).unwrap_or_default();
    if let Some(known) = links.iter().find_map(|link| link.offer()) {
        return Ok(known);
    }
    // A recent registration may not have reached our own graph yet.
    let graph = watcher::fetch(bus).await?;
    let Some(topic) = graph.topics.get(name) else {
        return Err(BusError::NoTopic(name.to_owned()));
    };
    let mut failure = None;
    let publishers = topic.publishers.iter().filter(|node| **node != bus.node);
    for uri in publishers.filter_map(|node| graph.nodes.get(node)) {
        match link::connect(bus, name, uri, &WireType::any()).await {
            Ok(connection) if !connection.wire_type.digest.is_any() => {
                return Ok(offer(connection.wire_type, connection.latching));
            }
            Ok(_) => {}
            Err(error) => failure = Some(error),
        }
    }
    if let Some(asked) = subscriber_type(bus, name, topic, &graph).await? {
        return Ok(offer(asked, false));
    }
    match failure {
        _ if topic.type_name != "*" => Ok(offer(WireType::with_name(&topic.type_name), false)),
        Some(failure) => Err(failure),
        None => Ok(offer(WireType::any(), false)),
    }
}

/// Returns the type requested by the topic's subscribers: the first specific one.
async fn subscriber_type(
    bus: &Arc<Ros1BusState>,
    name: &str,
    topic: &TopicNodes,
    graph: &Graph,
) -> Result<Option<WireType>, BusError> {
    let others = |node: &&String| **node != bus.node && graph.nodes.contains_key(*node);
    let mut missing = topic.subscribers.iter().filter(others).count();
    if missing == 0 {
        return Ok(None);
    }
    let mut asking = publications::ask_subscribers(bus, name);
    bus.registrar.sync(Kind::Publisher, name, false).await?;
    let heard = timeout(ANSWER, async {
        let mut best = None;
        while missing > 0 {
            let Some(asked) = asking.answers.recv().await else {
                break;
            };
            if !asked.digest.is_any() {
                return Some(asked);
            }
            missing -= 1;
            best = best.or(Some(asked).filter(|asked| asked.name != "*"));
        }
        best
    });
    Ok(heard.await.unwrap_or(None))
}
