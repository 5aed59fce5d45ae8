//! Calls and goals of a client that are in progress: limits on their number and on the bytes of their arguments.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use budget::{Exceeded, Permit, UNCOUNTED};
use rosbridge::Payload;

use super::BridgeClient;

/// Reasons why a client may not begin another call or goal.
#[derive(Debug, thiserror::Error)]
pub(super) enum BeginCallError {
    #[error(
        "field \"args\" has {bytes} bytes, which together with the calls and goals under way is more than {limit}; \
            wait for some to end"
    )]
    TooManyBytes { bytes: usize, limit: usize },
    #[error("{0} calls and goals of this client are under way already; wait for some to end")]
    TooManyCalls(usize),
    #[error("field \"args\": {0}")]
    NoRoom(#[from] Exceeded),
}

/// Guard of a call or goal in progress.
pub(super) struct InFlightGuard {
    client: Arc<BridgeClient>,
    /// Bytes of its arguments.
    bytes: usize,
    /// Permit for those bytes, if the client's total is above the uncounted size.
    _permit: Option<Permit>,
}

impl Drop for InFlightGuard {
    fn drop(&mut self) {
        self.client.under_way.fetch_sub(1, Ordering::Relaxed);
        self.client.under_way_bytes.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

impl BridgeClient {
    /// Counts a call or goal with these arguments as in progress until the guard is dropped.
    pub(super) fn begin_call(self: &Arc<Self>, args: Option<Payload<'_>>) -> Result<InFlightGuard, BeginCallError> {
        let options = &self.shared.options;
        let limit = options.max_calls;
        let bytes = args.map_or(0, |args| args.bytes.len());
        let before = self.under_way.fetch_add(1, Ordering::Relaxed);
        let bytes_before = self.under_way_bytes.fetch_add(bytes, Ordering::Relaxed);
        let mut guard = InFlightGuard { client: self.clone(), bytes, _permit: None };
        if bytes_before > 0 && bytes_before.saturating_add(bytes) > options.max_call_bytes {
            return Err(BeginCallError::TooManyBytes { bytes, limit: options.max_call_bytes });
        }
        if before >= limit {
            return Err(BeginCallError::TooManyCalls(limit));
        }
        if bytes_before.saturating_add(bytes) > UNCOUNTED {
            // They wait for a servant, possibly for long.
            guard._permit = Some(self.budget.take(bytes)?);
        }
        Ok(guard)
    }
}
