//! `/api/v1/stream`: what the page shows, as it changes. One task looks at the machine for all who listen, and only while somebody
//! does; each is told the difference between what it was told last and what is so when it can take more.
//!
//! ```text
//!              ┌─▶ sampler ──newest sample──▶ listener: what its caller sees, less what it was told ─▶ SSE
//!   an event, ─┘                         └──▶ listener …
//!   or a second
//! ```
//!
//! So nothing is queued for who reads slowly: it misses what was between, but for events, which are kept until there are too
//! many; then it is told all anew.

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
use sampler::Sample;

/// Streams of one principal from one client: pages that are open beside each other, logs and events that are followed.
const MOST: usize = 32;
/// A comment this often tells proxies and pages that the connection is there.
const ALIVE: Duration = Duration::from_secs(15);

/// The newest sample, for all who listen.
pub struct Live {
    newest: watch::Sender<Option<Arc<Sample>>>,
    /// Whether the sampler runs.
    running: Mutex<bool>,
    /// How many streams each has.
    streams: Arc<Mutex<HashMap<String, usize>>>,
}

impl Default for Live {
    fn default() -> Live {
        Live {
            newest: watch::Sender::new(None),
            running: Mutex::new(false),
            streams: Arc::default(),
        }
    }
}

impl Live {
    /// The newest sample, from now on; begins to look where nobody has listened.
    fn listen(app: &Arc<App>) -> watch::Receiver<Option<Arc<Sample>>> {
        let samples = app.live.newest.subscribe();
        let mut running = app.live.running.lock();
        if !*running {
            *running = true;
            tokio::spawn(sampler::run(Arc::clone(app)));
        }
        samples
    }

    /// Whether the sampler may end: nobody listens any more, and who comes later begins another.
    fn rests(&self) -> bool {
        let mut running = self.running.lock();
        if self.newest.receiver_count() > 0 {
            return false;
        }
        // Who comes is not told what was so once.
        self.newest.send_replace(None);
        *running = false;
        true
    }

    /// A place for a stream of the caller's.
    pub fn place(&self, caller: &Caller) -> Result<Place, Error> {
        let who = format!("{} {}", caller.who.principal, caller.peer.client(None));
        self.place_of(who)
    }

    fn place_of(&self, who: String) -> Result<Place, Error> {
        let mut streams = self.streams.lock();
        let count = streams.entry(who.clone()).or_default();
        if *count >= MOST {
            return Err(Error::TooManyStreams { most: MOST });
        }
        *count += 1;
        Ok(Place {
            streams: Arc::clone(&self.streams),
            who,
        })
    }
}

/// One stream of those that somebody may have.
pub struct Place {
    streams: Arc<Mutex<HashMap<String, usize>>>,
    who: String,
}

impl Drop for Place {
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
    let place = app.live.place(&caller)?;
    let ending = caller.over(&app, "");
    let listener = Listener::new(Arc::clone(&app), caller, Live::listen(&app), place);
    let told = futures_util::stream::unfold(listener, |mut listener| async move {
        let event = listener.next().await?;
        Some((Ok::<_, Infallible>(event), listener))
    });
    // No proxy collects what is to be seen at once.
    let unkept = [("cache-control", "no-store"), ("x-accel-buffering", "no")];
    let events = Sse::new(told.take_until(ending)).keep_alive(KeepAlive::new().interval(ALIVE));
    Ok((unkept, events))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_principal_has_so_many_streams_and_no_more() {
        let live = Live::default();
        let mut places: Vec<_> = (0..MOST)
            .map(|_| live.place_of("ada".into()).expect("room"))
            .collect();
        let refused = live.place_of("ada".into()).map(|_| ());
        assert!(matches!(refused, Err(Error::TooManyStreams { most: MOST })));
        let of_another = live.place_of("bob".into()).expect("room of his own");
        drop(places.pop());
        places.push(live.place_of("ada".into()).expect("room again"));
        drop((places, of_another));
        assert!(live.streams.lock().is_empty(), "nothing is left behind");
    }

    #[test]
    fn the_sampler_ends_when_nobody_listens() {
        let live = Live::default();
        *live.running.lock() = true;
        let listening = live.newest.subscribe();
        assert!(!live.rests());
        drop(listening);
        assert!(live.rests());
        assert!(!*live.running.lock());
    }
}
