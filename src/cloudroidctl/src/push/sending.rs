//! Sending a push and following it until it ends, is left alone or is stopped.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use anyhow::bail;
use api::{PushEvent, PushStatus, ServiceDetail};
use futures_util::StreamExt;
use hyper::{HeaderMap, Method, header};

use super::archive::{Packing, PushSource};
use super::interrupt::InterruptAnswer;
use super::progress::{self, PushProgress};
use crate::client::{self, DaemonClient};
use crate::output;

/// A push to be sent.
pub struct PushRequest {
    /// Path and query.
    pub uri: String,
    /// Body of the request; `None` if it has none.
    pub source: Option<PushSource>,
    /// True if the push is left alone once it is sent.
    pub is_detached: bool,
}

/// Publishes a package; `None` if the push goes on without this command, and for an underlay. `on_interrupt` decides
/// what becomes of the push with this number.
pub async fn publish(
    client: &DaemonClient,
    request: PushRequest,
    mut progress: PushProgress,
    on_interrupt: impl AsyncFn(u64) -> InterruptAnswer,
) -> anyhow::Result<Option<ServiceDetail>> {
    let state = SentPush::default();
    let pause = progress.pauses();
    let mut sending = Box::pin(send(client, &mut progress, request, &state));
    let mut is_stopping = false;
    loop {
        tokio::select! {
            outcome = &mut sending => match outcome {
                Err(_) if is_stopping => bail!(CANCELLED),
                outcome => return outcome,
            },
            _ = tokio::signal::ctrl_c() => {}
        }
        let Some(number) = state.number() else { bail!(CANCELLED) };
        if !state.is_accepted() {
            // It ends with this command; if it was just accepted, by being cancelled.
            let _ = stop(client, number).await;
            bail!(CANCELLED);
        }
        if is_stopping {
            bail!("push {number} is being cancelled; see cloudroidctl pushes");
        }
        if state.publishing.load(Ordering::Relaxed) {
            bail!("interrupted, but the daemon goes on publishing; see cloudroidctl services");
        }
        pause.begin();
        let answer = on_interrupt(number).await;
        pause.end();
        match answer {
            InterruptAnswer::Stop => is_stopping = stop(client, number).await?,
            InterruptAnswer::Leave => {
                output::eprint_line(&continuation(number));
                return Ok(None);
            }
            InterruptAnswer::Follow => {}
        }
    }
}

/// Message for a push that was stopped from here.
const CANCELLED: &str = "cancelled; nothing was published";

/// State of the push that is being sent.
#[derive(Debug, Default)]
struct SentPush {
    /// Number of the push; 0 while it is unknown.
    number: AtomicU64,
    /// True once the push continues without this command.
    accepted: AtomicBool,
    /// True once the daemon publishes, after which the push cannot be cancelled.
    publishing: AtomicBool,
}

impl SentPush {
    fn number(&self) -> Option<u64> {
        Some(self.number.load(Ordering::Relaxed)).filter(|number| *number > 0)
    }

    fn is_accepted(&self) -> bool {
        self.accepted.load(Ordering::Relaxed)
    }

    /// Reads the number of the push from the head of the response.
    fn read_number(&self, headers: &HeaderMap) {
        let location = headers.get(header::LOCATION).and_then(|location| location.to_str().ok());
        let number = location.and_then(|location| location.rsplit('/').next()?.parse().ok());
        self.number.store(number.unwrap_or_default(), Ordering::Relaxed);
    }
}

/// Cancels a push; false if that is too late, which its output then shows.
async fn stop(client: &DaemonClient, number: u64) -> anyhow::Result<bool> {
    match client.delete::<PushStatus>(&format!("/api/v1/pushes/{number}")).await {
        Ok(_) => Ok(true),
        Err(error) if error.downcast_ref::<api::Problem>().is_some_and(|problem| problem.status == 409) => {
            output::eprint_line(&format!("{error:#}"));
            Ok(false)
        }
        Err(error) => Err(error),
    }
}

/// Describes how to go on with a push that continues without this command.
fn continuation(number: u64) -> String {
    format!(
        "push {number} continues on the server; follow it with: cloudroidctl pushes logs {number} --follow; stop it \
            with: cloudroidctl pushes cancel {number}"
    )
}

/// Sends the package and shows the progress until the push ends; if it is detached, until the package is sent. Returns
/// `None` if the push continues, and for an underlay.
async fn send(
    client: &DaemonClient,
    progress: &mut PushProgress,
    PushRequest { uri, source, is_detached }: PushRequest,
    state: &SentPush,
) -> anyhow::Result<Option<ServiceDetail>> {
    let (body, packing) = match source {
        Some(source) => {
            let (body, packing) = source.into_body();
            (body, Some(packing))
        }
        None => (client::empty_body(), None),
    };
    let response = match client.send(Method::POST, &uri, body).await {
        Ok(response) => response,
        Err(error) => return Err(packing_error(packing).unwrap_or(error)),
    };
    state.read_number(response.headers());
    let mut events = client::json_lines::<PushEvent>(response);
    let mut ticks = tokio::time::interval(progress::TICK);
    loop {
        let event = tokio::select! {
            event = events.next() => event,
            _ = ticks.tick() => {
                if !is_detached {
                    progress.tick()?;
                }
                continue;
            }
        };
        let accepted = state.number().filter(|_| state.is_accepted());
        let event = match (event, accepted) {
            (Some(Ok(event)), _) => event,
            (Some(Err(error)), Some(number)) if client::is_unavailable(&error) => {
                return Err(error.context(format!("lost sight of push {number}; see cloudroidctl pushes")));
            }
            (Some(Err(error)), _) => return Err(packing_error(packing).unwrap_or(error)),
            (None, _) => bail!("the daemon aborted the push; see its log, and cloudroidctl status"),
        };
        if !is_detached {
            progress.show(&event)?;
        }
        match event {
            PushEvent::Accepted { number } => {
                state.number.store(number, Ordering::Relaxed);
                state.accepted.store(true, Ordering::Relaxed);
                if is_detached {
                    output::eprint_line(&continuation(number));
                    progress.show_number(number)?;
                    return Ok(None);
                }
            }
            // Title of the daemon's last step.
            PushEvent::Step { title, .. } if title == api::push::PUBLISHING => {
                state.publishing.store(true, Ordering::Relaxed);
            }
            PushEvent::Done { service, .. } => return Ok(Some(*service)),
            // Nothing of it is run, so there is nothing to describe.
            PushEvent::Underlay { .. } => return Ok(None),
            PushEvent::Error { problem } => {
                return Err(packing_error(packing).unwrap_or_else(|| problem.into()));
            }
            _ => {}
        }
    }
}

/// Returns the error of packing, if any: it is the cause, whatever the daemon reported about the truncated stream.
fn packing_error(packing: Option<Packing>) -> Option<anyhow::Error> {
    packing.and_then(Packing::into_error)
}
