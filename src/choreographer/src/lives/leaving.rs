//! Ends the statements of clients that have left: if none of a client's connections comes back within the grace time,
//! its servant gets the terms of the remaining clients.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use api::Phase;
use tokio::time::{Instant, MissedTickBehavior, interval};

use super::ChoreographerInner;
use super::measuring::ResizeRefusal;
use super::visits::Visits;
use crate::Error;
use crate::lives::handle::Handle;

/// Interval between two rounds.
const LOOK: Duration = Duration::from_secs(1);

/// Runs the watch until the daemon ends.
pub(crate) async fn watch(inner: Arc<ChoreographerInner>) {
    let mut refusals: HashMap<String, ResizeRefusal> = HashMap::new();
    let mut visits: Visits<(Arc<Handle>, Result<(), Error>)> = Visits::default();
    let mut looks = interval(LOOK);
    looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let grace = inner.options.grace;
    loop {
        looks.tick().await;
        if inner.is_ending() {
            return;
        }
        for (id, (handle, outcome)) in visits.take_finished() {
            let refused = ResizeRefusal::from_outcome(refusals.remove(&id), outcome, &inner, &handle);
            refusals.extend(refused.map(|refused| (id, refused)));
        }
        let handles: Vec<Arc<Handle>> = inner.servants.lock().all.values().cloned().collect();
        let has_left = |handle: &Arc<Handle>| {
            handle.life().phase == Phase::Ready
                && !handle.is_ending()
                // If all have left, the servant itself ends.
                && handle.connections() > 0
                && !handle.clients_away_for(grace).is_empty()
        };
        let left: Vec<Arc<Handle>> = handles.into_iter().filter(has_left).collect();
        refusals.retain(|id, _| left.iter().any(|handle| handle.id == *id));
        for handle in left {
            let now = Instant::now();
            let refused = refusals.get(&handle.id);
            if refused.is_some_and(|refused| !refused.is_due(now)) {
                continue;
            }
            let (id, inner) = (handle.id.clone(), Arc::clone(&inner));
            visits.begin(&id, async move {
                let outcome = inner.forget_stated(&handle, grace).await;
                (handle, outcome)
            });
        }
    }
}
