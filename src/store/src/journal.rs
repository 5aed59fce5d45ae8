//! Journal of events, written to the state database and to the daemon's log.

use std::sync::Arc;
use std::time::SystemTime;

use api::Level;

use super::{NewEvent, State, millis};

/// Writer of events.
#[derive(Clone)]
pub struct Journal {
    state: Arc<State>,
}

impl Journal {
    /// Creates a journal that writes to `state`.
    pub fn new(state: Arc<State>) -> Journal {
        Journal { state }
    }

    /// Records an event of normal operation.
    pub fn info(&self, kind: &str, message: &str, about: &NewEvent<'_>) {
        tracing::info!("{message}");
        self.write(Level::Info, kind, message, about);
    }

    /// Records an event that deserves attention.
    pub fn warning(&self, kind: &str, message: &str, about: &NewEvent<'_>) {
        tracing::warn!("{message}");
        self.write(Level::Warning, kind, message, about);
    }

    /// Records a failure.
    pub fn error(&self, kind: &str, message: &str, about: &NewEvent<'_>) {
        tracing::error!("{message}");
        self.write(Level::Error, kind, message, about);
    }

    /// Records that from `at` on a robot's node is served by its local original, for the reason `why`, or by the cloud
    /// again if `None`. `of` is the service, robot and node.
    pub fn record_local_period(&self, of: (&str, &str, &str), at: SystemTime, why: Option<&str>) {
        let at = millis(at);
        let written = match why {
            Some(why) => self.state.begin_local_period(of, at, why),
            None => self.state.end_local_period(of, at),
        };
        if let Err(error) = written {
            tracing::warn!("the history will not show when {} was served locally: {error}", of.1);
        }
    }

    fn write(&self, level: Level, kind: &str, message: &str, about: &NewEvent<'_>) {
        self.state.add_event(level, kind, message, about);
    }
}
