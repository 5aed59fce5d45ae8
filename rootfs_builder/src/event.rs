//! What a build tells while it runs.

use std::sync::Arc;

use tokio::sync::mpsc;

/// One thing told.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum BuildEvent {
    /// A new step begins.
    Step {
        /// What is done now.
        title: String,
    },
    /// One line of a program's output.
    Log {
        /// Without the line end.
        line: String,
    },
    /// How far the step is.
    Progress {
        /// What is counted.
        unit: &'static str,
        /// Number of those that are done.
        done: u64,
        /// Number of all, where it is known.
        total: Option<u64>,
    },
    /// It waits until another push has made a layer that both need.
    Waits {
        /// The service of that push, or the package that becomes one.
        push: String,
    },
    /// Something to know that is no failure.
    Warning {
        /// The text, for people.
        message: String,
    },
}

/// The sending end. A listener that went away stops nothing; cancelling is dropping the build's future.
#[derive(Debug, Clone)]
pub struct Progress(Arc<mpsc::Sender<BuildEvent>>);

impl Progress {
    /// Tells this listener.
    pub fn new(sender: mpsc::Sender<BuildEvent>) -> Self {
        Self(Arc::new(sender))
    }

    pub(crate) async fn step(&self, title: &str) {
        let _ = self
            .0
            .send(BuildEvent::Step {
                title: title.to_owned(),
            })
            .await;
    }

    pub(crate) async fn log(&self, line: &str) {
        let _ = self
            .0
            .send(BuildEvent::Log {
                line: line.to_owned(),
            })
            .await;
    }

    pub(crate) async fn waits(&self, push: String) {
        let _ = self.0.send(BuildEvent::Waits { push }).await;
    }

    pub(crate) async fn warn(&self, message: impl Into<String>) {
        let _ = self
            .0
            .send(BuildEvent::Warning {
                message: message.into(),
            })
            .await;
    }

    /// A number is worth something only now: dropped when the listener is busy.
    pub(crate) fn count(&self, unit: &'static str, done: u64, total: Option<u64>) {
        let _ = self.0.try_send(BuildEvent::Progress { unit, done, total });
    }
}
