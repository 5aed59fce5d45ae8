//! What type a topic has, as its ends say.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::timeout;

use super::bus::Inner;
use super::names;
use super::seen::{self, Seen};
use crate::bus::{BusError, WireType};

/// For ends that have just come to be discovered.
const GRACE: Duration = Duration::from_millis(300);

/// The type by whatever is at hand: what we advertise, what publishers offer, what subscribers ask for. Its digest is `*` where
/// they do not tell it.
pub(super) async fn find(bus: &Arc<Inner>, name: &str) -> Result<WireType, BusError> {
    if let Some((ours, _)) = bus.adverts.lock().get(name) {
        return Ok(WireType::clone(ours));
    }
    let topic = names::topic_name(name);
    let mut seen = bus.seen.subscribe();
    let found = timeout(GRACE, async {
        loop {
            if let Some(found) = known(&seen.borrow_and_update(), &topic) {
                return Ok(found);
            }
            seen.changed().await.map_err(|_| BusError::Closed)?;
        }
    });
    let nobody = |_| Err(BusError::NoTopic(name.to_owned()));
    found.await.unwrap_or_else(nobody)
}

fn known(seen: &Seen, topic: &str) -> Option<WireType> {
    for ends in [seen.writers(topic), seen.readers(topic)] {
        let mut types = ends.iter().map(|end| seen::wire_type(end));
        let first = types.next();
        let hashed = first
            .clone()
            .into_iter()
            .chain(types)
            .find(|it| !it.digest.is_any());
        if let Some(found) = hashed.or(first) {
            return Some(found);
        }
    }
    None
}
