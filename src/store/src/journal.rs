//! Events: written to the state database and to the daemon's log.

use std::sync::Arc;
use std::time::SystemTime;

use api::Level;

use super::{NewEvent, State, millis};

/// Where events go.
#[derive(Clone)]
pub struct Journal {
    state: Arc<State>,
}

impl Journal {
    /// Into `state`.
    pub fn new(state: Arc<State>) -> Journal {
        Journal { state }
    }

    /// As it should be.
    pub fn info(&self, kind: &str, message: &str, about: &NewEvent<'_>) {
        tracing::info!("{message}");
        self.write(Level::Info, kind, message, about);
    }

    /// Worth a look.
    pub fn warning(&self, kind: &str, message: &str, about: &NewEvent<'_>) {
        tracing::warn!("{message}");
        self.write(Level::Warning, kind, message, about);
    }

    /// Something failed.
    pub fn error(&self, kind: &str, message: &str, about: &NewEvent<'_>) {
        tracing::error!("{message}");
        self.write(Level::Error, kind, message, about);
    }

    /// From `at` on a robot's node is served by its local original in place of a service, and why; none: by the cloud again. `of`:
    /// service, robot, node.
    pub fn local(&self, of: (&str, &str, &str), at: SystemTime, why: Option<&str>) {
        let at = millis(at);
        let written = match why {
            Some(why) => self.state.begin_local(of, at, why),
            None => self.state.end_local(of, at),
        };
        if let Err(error) = written {
            tracing::warn!(
                "the history will not show when {} was served locally: {error}",
                of.1
            );
        }
    }

    fn write(&self, level: Level, kind: &str, message: &str, about: &NewEvent<'_>) {
        self.state.add_event(level, kind, message, about);
    }
}
