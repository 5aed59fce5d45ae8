//! The list of the logs that are kept of ended servants.

use api::KeptLog;
use parking_lot::Mutex;

/// Logs of ended servants.
#[derive(Default)]
pub(crate) struct KeptLogs {
    /// Newest first.
    pub(crate) known: Mutex<Vec<KeptLog>>,
    /// Held while the list changes, until the files have changed as well.
    pub(crate) turn: tokio::sync::Mutex<()>,
}
