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
pub mod live;
mod sampler;

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::Extension;
use axum::extract::State;
use axum::response::IntoResponse;
use axum::response::sse::{KeepAlive, Sse};
use futures_util::StreamExt;
use tokio::sync::watch;

use crate::app::App;
use crate::caller::Caller;
use crate::errors::Error;
use listener::Listener;
use live::{LiveSamples, StateSample};

/// Interval of keep-alive comments, by which proxies and pages see that the connection is open.
const ALIVE: Duration = Duration::from_secs(15);

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
