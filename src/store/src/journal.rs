//! Events: written to the state database and to the daemon's log.

use std::sync::Arc;

use api::Level;

use super::{NewEvent, State};

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

    fn write(&self, level: Level, kind: &str, message: &str, about: &NewEvent<'_>) {
        self.state.add_event(level, kind, message, about);
    }
}
