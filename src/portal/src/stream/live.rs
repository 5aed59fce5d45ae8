//! Live samples, shared by the sampler and all listeners.

use std::sync::Arc;

use api::explain::Served;
use api::stream::Machine;
use api::{BackOff, Event, ServiceSummary};
use parking_lot::Mutex;
use tokio::sync::watch;

use crate::caller::Caller;
use crate::errors::Error;
use crate::slots::{Slot, Slots};

/// Limit on the streams of one principal from one client: open pages, and followed logs and events.
const MAX_STREAMS: usize = 32;

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
    /// Streams, by their client.
    streams: Slots<String>,
}

impl Default for LiveSamples {
    fn default() -> LiveSamples {
        LiveSamples { newest: watch::Sender::new(None), running: Mutex::new(false), streams: Slots::default() }
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
    pub fn acquire_slot(&self, caller: &Caller) -> Result<Slot<String>, Error> {
        let who = format!("{} {}", caller.who.principal, caller.peer.budget_name(None));
        self.streams.acquire(who, MAX_STREAMS).ok_or(Error::TooManyStreams { most: MAX_STREAMS })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
