//! What a client states ends with it: when none of its connections came back within the grace time, its servant has the terms of
//! the clients that are left.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use api::Phase;
use tokio::time::{Instant, MissedTickBehavior, interval};

use super::Inner;
use super::measuring::Refusal;
use super::visits::Visits;
use crate::Error;
use crate::lives::handle::Handle;

/// Between two looks.
const LOOK: Duration = Duration::from_secs(1);

/// Looks, for ever.
pub(crate) async fn watch(inner: Arc<Inner>) {
    let mut refusals: HashMap<String, Refusal> = HashMap::new();
    let mut visits: Visits<(Arc<Handle>, Result<(), Error>)> = Visits::default();
    let mut looks = interval(LOOK);
    looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let grace = inner.options.grace;
    loop {
        looks.tick().await;
        if inner.is_ending() {
            return;
        }
        for (id, (handle, outcome)) in visits.take_over() {
            let refused = Refusal::after(refusals.remove(&id), outcome, &inner, &handle);
            refusals.extend(refused.map(|refused| (id, refused)));
        }
        let handles: Vec<Arc<Handle>> = inner.servants.lock().all.values().cloned().collect();
        let has_left = |handle: &Arc<Handle>| {
            handle.life().phase == Phase::Ready
                && !handle.is_ending()
                // Where all have left, the servant itself ends.
                && handle.connections() > 0
                && !handle.away_for(grace).is_empty()
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
