//! Live samples, shared by the sampler and all listeners.

use std::collections::HashMap;
use std::sync::Arc;

use api::explain::Served;
use api::stream::Machine;
use api::{BackOff, Event, ServiceSummary};
use parking_lot::Mutex;
use tokio::sync::watch;

use crate::caller::Caller;
use crate::errors::Error;

/// Limit on the streams of one principal from one client: open pages, and followed logs and events.
const MOST: usize = 32;

/// State at one moment. What has not changed since the previous sample is the same allocation.
#[derive(Default)]
pub struct StateSample {
    pub machine: Option<Arc<Machine>>,
    pub services: Vec<Arc<ServiceSummary>>,
    pub servants: Vec<Arc<Served>>,
    pub back_offs: Arc<Vec<BackOff>>,
    /// The newest events, oldest first.
    pub events: Arc<Vec<Arc<Event>>>,
}

/// Live samples for all listeners.
pub struct LiveSamples {
    pub(super) newest: watch::Sender<Option<Arc<StateSample>>>,
    /// True while the sampler runs.
    pub(super) running: Mutex<bool>,
    /// Number of streams of each client.
    streams: Arc<Mutex<HashMap<String, usize>>>,
}

impl Default for LiveSamples {
    fn default() -> LiveSamples {
        LiveSamples { newest: watch::Sender::new(None), running: Mutex::new(false), streams: Arc::default() }
    }
}

impl LiveSamples {
    /// Returns true if the sampler may stop because nobody listens; the next listener starts another.
    pub(super) fn try_stop(&self) -> bool {
        let mut running = self.running.lock();
        if self.newest.receiver_count() > 0 {
            return false;
        }
        // The next listener must not receive an outdated sample.
        self.newest.send_replace(None);
        *running = false;
        true
    }

    /// Acquires a slot for a stream of the caller.
    pub fn acquire_slot(&self, caller: &Caller) -> Result<StreamSlot, Error> {
        let who = format!("{} {}", caller.who.principal, caller.peer.budget_name(None));
        self.acquire_slot_for(who)
    }

    fn acquire_slot_for(&self, who: String) -> Result<StreamSlot, Error> {
        let mut streams = self.streams.lock();
        let count = streams.entry(who.clone()).or_default();
        if *count >= MOST {
            return Err(Error::TooManyStreams { most: MOST });
        }
        *count += 1;
        Ok(StreamSlot { streams: Arc::clone(&self.streams), who })
    }
}

/// Slot of one stream; released when dropped.
pub struct StreamSlot {
    streams: Arc<Mutex<HashMap<String, usize>>>,
    who: String,
}

impl Drop for StreamSlot {
    fn drop(&mut self) {
        let mut streams = self.streams.lock();
        if let Some(count) = streams.get_mut(&self.who) {
            *count -= 1;
            if *count == 0 {
                streams.remove(&self.who);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_principal_has_so_many_streams_and_no_more() {
        let live = LiveSamples::default();
        let mut places: Vec<_> = (0..MOST).map(|_| live.acquire_slot_for("ada".into()).expect("room")).collect();
        let refused = live.acquire_slot_for("ada".into()).map(|_| ());
        assert!(matches!(refused, Err(Error::TooManyStreams { most: MOST })));
        let of_another = live.acquire_slot_for("bob".into()).expect("room of his own");
        drop(places.pop());
        places.push(live.acquire_slot_for("ada".into()).expect("room again"));
        drop((places, of_another));
        assert!(live.streams.lock().is_empty(), "nothing is left behind");
    }

    #[test]
    fn the_sampler_ends_when_nobody_listens() {
        let live = LiveSamples::default();
        *live.running.lock() = true;
        let listening = live.newest.subscribe();
        assert!(!live.try_stop());
        drop(listening);
        assert!(live.try_stop());
        assert!(!*live.running.lock());
    }
}
