//! Progress events of a build.

use std::sync::Arc;

use tokio::sync::mpsc;

/// A progress event.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum BuildEvent {
    /// A new step begins.
    Step {
        /// Title of the step.
        title: String,
    },
    /// A line of a program's output.
    Log {
        /// The line, without its line terminator.
        line: String,
    },
    /// Progress of the current step.
    Progress {
        /// Unit that is counted.
        unit: &'static str,
        /// Number of units done.
        done: u64,
        /// Total number of units, if known.
        total: Option<u64>,
    },
    /// The build waits for another push to make something that both need.
    Waits {
        /// Id of that push; see [`crate::PushRequest::id`].
        id: String,
        /// Service of that push, or the package that becomes one.
        push: String,
    },
    /// The build no longer waits for another push.
    Continues,
    /// A warning; the build continues.
    Warning {
        /// Human-readable text.
        message: String,
    },
}

/// Sender of progress events. A listener that has gone does not stop the build; to cancel it, drop its future.
#[derive(Debug, Clone)]
pub struct Progress(Arc<mpsc::Sender<BuildEvent>>);

impl Progress {
    /// Creates a sender to this listener.
    pub fn new(sender: mpsc::Sender<BuildEvent>) -> Self {
        Self(Arc::new(sender))
    }

    pub(crate) async fn step(&self, title: &str) {
        let _ = self.0.send(BuildEvent::Step { title: title.to_owned() }).await;
    }

    pub(crate) async fn log(&self, line: &str) {
        let _ = self.0.send(BuildEvent::Log { line: line.to_owned() }).await;
    }

    pub(crate) async fn waits(&self, id: String, push: String) {
        let _ = self.0.send(BuildEvent::Waits { id, push }).await;
    }

    pub(crate) async fn continues(&self) {
        let _ = self.0.send(BuildEvent::Continues).await;
    }

    pub(crate) async fn warn(&self, message: impl Into<String>) {
        let _ = self.0.send(BuildEvent::Warning { message: message.into() }).await;
    }

    /// Sends a progress count; dropped if the listener is busy, since only the latest one matters.
    pub(crate) fn count(&self, unit: &'static str, done: u64, total: Option<u64>) {
        let _ = self.0.try_send(BuildEvent::Progress { unit, done, total });
    }
}
