//! `/api/v1/stream`: live updates for the page. One task samples the machine for all listeners, and only while there
//! are any; each listener receives the difference between what it was last sent and the state when it can take more.
//!
//! ```text
//!              ┌─▶ sampler ──newest sample──▶ listener: what its caller may see, less the state last sent ─▶ SSE
//!   an event, ─┘                         └──▶ listener …
//!   or a second
//! ```
//!
//! So nothing is queued for slow readers: they miss intermediate states, except for events, which are kept up to a
//! limit; beyond it, the listener receives a new snapshot.

mod listener;
mod sampler;

use std::collections::HashMap;
use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::Extension;
use axum::extract::State;
use axum::response::IntoResponse;
use axum::response::sse::{KeepAlive, Sse};
use futures_util::StreamExt;
use parking_lot::Mutex;
use tokio::sync::watch;

use crate::app::App;
use crate::errors::Error;
use crate::guard::Caller;
use listener::Listener;
use sampler::StateSample;

/// Limit on the streams of one principal from one client: open pages, and followed logs and events.
const MOST: usize = 32;
/// Interval of keep-alive comments, by which proxies and pages see that the connection is open.
const ALIVE: Duration = Duration::from_secs(15);

/// Live samples for all listeners.
pub struct LiveSamples {
    newest: watch::Sender<Option<Arc<StateSample>>>,
    /// True while the sampler runs.
    running: Mutex<bool>,
    /// Number of streams of each client.
    streams: Arc<Mutex<HashMap<String, usize>>>,
}

impl Default for LiveSamples {
    fn default() -> LiveSamples {
        LiveSamples {
            newest: watch::Sender::new(None),
            running: Mutex::new(false),
            streams: Arc::default(),
        }
    }
}

impl LiveSamples {
    /// Subscribes to the newest sample, starting the sampler if necessary.
    fn listen(app: &Arc<App>) -> watch::Receiver<Option<Arc<StateSample>>> {
        let samples = app.live.newest.subscribe();
        let mut running = app.live.running.lock();
        if !*running {
            *running = true;
            tokio::spawn(sampler::run(Arc::clone(app)));
        }
        samples
    }

    /// Returns true if the sampler may stop because nobody listens; the next listener starts another.
    fn try_stop(&self) -> bool {
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
        Ok(StreamSlot {
            streams: Arc::clone(&self.streams),
            who,
        })
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

/// Machine, services, servants and events as they change.
pub async fn stream(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
) -> Result<impl IntoResponse, Error> {
    let place = app.live.acquire_slot(&caller)?;
    let ending = caller.wait_for_end(&app, "");
    let listener = Listener::new(Arc::clone(&app), caller, LiveSamples::listen(&app), place);
    let told = futures_util::stream::unfold(listener, |mut listener| async move {
        let event = listener.next().await?;
        Some((Ok::<_, Infallible>(event), listener))
    });
    // Forbids proxies to buffer live updates.
    let unkept = [("cache-control", "no-store"), ("x-accel-buffering", "no")];
    let events = Sse::new(told.take_until(ending)).keep_alive(KeepAlive::new().interval(ALIVE));
    Ok((unkept, events))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_principal_has_so_many_streams_and_no_more() {
        let live = LiveSamples::default();
        let mut places: Vec<_> = (0..MOST)
            .map(|_| live.acquire_slot_for("ada".into()).expect("room"))
            .collect();
        let refused = live.acquire_slot_for("ada".into()).map(|_| ());
        assert!(matches!(refused, Err(Error::TooManyStreams { most: MOST })));
        let of_another = live
            .acquire_slot_for("bob".into())
            .expect("room of his own");
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
