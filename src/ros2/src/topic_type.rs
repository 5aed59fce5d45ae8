//! Type of a topic, determined from its endpoints.

use std::sync::Arc;
use std::time::Duration;

use ros_bus::{BusError, WireType};
use tokio::time::timeout;

use super::names;
use super::seen::{self, DiscoverySnapshot};
use super::state::Ros2BusState;

/// Time for new endpoints to be discovered.
const GRACE: Duration = Duration::from_millis(300);

/// Returns the type from the first source available: what we advertise, what publishers offer, what subscribers
/// request. Its digest is `*` if they do not announce it.
pub(super) async fn find(bus: &Arc<Ros2BusState>, name: &str) -> Result<WireType, BusError> {
    if let Some((ours, _)) = bus.adverts.lock().get(name) {
        return Ok(WireType::clone(ours));
    }
    let topic = names::topic_name(name);
    let mut seen = bus.seen.subscribe();
    let found = timeout(GRACE, async {
        loop {
            if let Some(found) = find_known(&seen.borrow_and_update(), &topic) {
                return Ok(found);
            }
            seen.changed().await.map_err(|_| BusError::Closed)?;
        }
    });
    let nobody = |_| Err(BusError::NoTopic(name.to_owned()));
    found.await.unwrap_or_else(nobody)
}

fn find_known(seen: &DiscoverySnapshot, topic: &str) -> Option<WireType> {
    for ends in [seen.writers(topic), seen.readers(topic)] {
        let mut types = ends.iter().map(|end| seen::wire_type(end));
        let first = types.next();
        let hashed = first.clone().into_iter().chain(types).find(|it| !it.digest.is_any());
        if let Some(found) = hashed.or(first) {
            return Some(found);
        }
    }
    None
}
