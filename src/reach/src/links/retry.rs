//! Pauses before what a bus has refused is tried again: by then its Master may be back, or another end of a topic be gone.

use std::time::Duration;

use tokio::time::sleep;

/// The pause after the first refusal, and the longest.
const PAUSES: (Duration, Duration) = (Duration::from_millis(250), Duration::from_secs(10));

/// Pauses that grow.
#[derive(Debug, Default)]
pub(super) struct Retry {
    refusals: u32,
}

impl Retry {
    /// Whether nothing was refused before: that is told once.
    pub(super) fn is_first(&self) -> bool {
        self.refusals == 0
    }

    /// Waits until it is time to try again.
    pub(super) async fn pause(&mut self) {
        let pause = PAUSES.0.saturating_mul(1 << self.refusals.min(16));
        self.refusals += 1;
        sleep(pause.min(PAUSES.1)).await;
    }
}
