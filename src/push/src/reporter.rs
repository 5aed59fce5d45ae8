//! Reports the progress of a push.

use api::PushEvent;
use package::requests::{Reason, Request};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::running::RunningPush;

/// Reports progress to the task of the push, which keeps it for clients.
#[derive(Clone)]
pub(super) struct Reporter {
    events: mpsc::Sender<PushEvent>,
    /// Tracks the build of this push while it runs.
    pub(super) building: TaskTracker,
    /// Cancelled when the push begins to publish, after which it can no longer be cancelled.
    pub(super) publishing: CancellationToken,
    /// Cancelled when the archive is complete.
    pub(super) received: CancellationToken,
}

impl Reporter {
    pub(super) fn new(events: mpsc::Sender<PushEvent>) -> Self {
        Self {
            events,
            building: TaskTracker::new(),
            publishing: CancellationToken::new(),
            received: CancellationToken::new(),
        }
    }

    /// Creates the reporter of a push that is registered.
    pub(super) fn for_push(events: mpsc::Sender<PushEvent>, running: &RunningPush) -> Self {
        Self { publishing: running.publishing.clone(), received: running.received.clone(), ..Self::new(events) }
    }

    pub(super) async fn step(&self, title: &str) {
        self.event(PushEvent::step(title)).await;
    }

    pub(super) async fn warning(&self, message: String) {
        self.event(PushEvent::Warning { message }).await;
    }

    /// Sends a warning if the queue is not full; for what cannot wait.
    pub(super) fn try_warning(&self, message: String) {
        let _ = self.events.try_send(PushEvent::Warning { message });
    }

    /// Reports a request pair.
    pub(super) async fn request(&self, request: &Request) {
        let words = request.to_string();
        match request.reason {
            Reason::Guessed => self.warning(words).await,
            Reason::Stated | Reason::Watched | Reason::Alone => {
                self.event(PushEvent::Log { line: words }).await;
            }
        }
    }

    pub(super) async fn event(&self, event: PushEvent) {
        let _ = self.events.send(event).await;
    }
}
