//! Calls and goals of a client that are under way: so many at once, with so many bytes of arguments.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use budget::{Permit, UNCOUNTED};
use rosbridge::Payload;

use super::Client;

/// One call or goal under way.
pub(super) struct UnderWay {
    client: Arc<Client>,
    /// Of its arguments.
    bytes: usize,
    /// For those, where the client has more of them than nobody counts.
    _permit: Option<Permit>,
}

impl Drop for UnderWay {
    fn drop(&mut self) {
        self.client.under_way.fetch_sub(1, Ordering::Relaxed);
        self.client
            .under_way_bytes
            .fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

impl Client {
    /// Counts a call or goal with these arguments as under way until the guard is dropped.
    pub(super) fn begin(self: &Arc<Self>, args: Option<Payload<'_>>) -> Result<UnderWay, String> {
        let options = &self.shared.options;
        let limit = options.max_calls;
        let bytes = args.map_or(0, |args| args.bytes.len());
        let before = self.under_way.fetch_add(1, Ordering::Relaxed);
        let bytes_before = self.under_way_bytes.fetch_add(bytes, Ordering::Relaxed);
        let mut guard = UnderWay {
            client: self.clone(),
            bytes,
            _permit: None,
        };
        if bytes_before > 0 && bytes_before.saturating_add(bytes) > options.max_call_bytes {
            return Err(format!(
                "field \"args\" has {bytes} bytes, with those of calls and goals under way more than {}; wait for some to end",
                options.max_call_bytes
            ));
        }
        if before >= limit {
            return Err(format!(
                "{limit} calls and goals of this client are under way already; wait for some to end"
            ));
        }
        if bytes_before.saturating_add(bytes) > UNCOUNTED {
            // They wait for a servant, perhaps for long.
            let permit = self.budget.take(bytes);
            guard._permit = Some(permit.map_err(|full| format!("field \"args\": {full}"))?);
        }
        Ok(guard)
    }
}
