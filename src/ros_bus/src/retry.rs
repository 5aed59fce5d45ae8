//! Backoff before a refused operation of a bus is retried: by then its Master may be back, or another endpoint of a
//! topic be gone.

use std::time::Duration;

use tokio::time::sleep;

/// First and longest pause.
const PAUSES: (Duration, Duration) = (Duration::from_millis(250), Duration::from_secs(10));

/// Exponential backoff of refused operations.
#[derive(Debug, Default)]
pub struct Retry {
    refusals: u32,
}

impl Retry {
    /// Returns whether nothing was refused before; only the first refusal is logged.
    pub fn is_first(&self) -> bool {
        self.refusals == 0
    }

    /// Waits until the next attempt is due.
    pub async fn pause(&mut self) {
        let pause = PAUSES.0.saturating_mul(1 << self.refusals.min(16));
        self.refusals += 1;
        sleep(pause.min(PAUSES.1)).await;
    }
}
