//! Filter for submessages that carry a count.

use std::time::{Duration, Instant};

/// Filters out duplicate and late submessages by their counts (8.3.8.1, 8.3.8.6).
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct CountFilter {
    last: Option<(u32, Instant)>,
}

/// Time after which any count is accepted: a participant that has heard nothing of us for its lease duration discovers
/// us anew and restarts its counts.
const TOO_LATE: Duration = Duration::from_secs(3);

impl CountFilter {
    /// Returns whether a submessage with this count is to be processed, and if so records the count.
    pub fn accept(&mut self, now: Instant, count: u32) -> bool {
        let heeded = self
            .last
            .is_none_or(|(before, at)| is_newer(count, before) || now.saturating_duration_since(at) > TOO_LATE);
        if heeded {
            self.last = Some((count, now));
        }
        heeded
    }
}

/// Returns whether a count is newer than another one, with wrap-around.
fn is_newer(count: u32, before: u32) -> bool {
    count.wrapping_sub(before).wrapping_sub(1) < u32::MAX / 2
}
