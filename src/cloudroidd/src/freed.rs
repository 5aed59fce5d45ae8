//! Return of freed memory to the kernel.

use std::time::Duration;

/// Interval between returns: long enough to cost an idle daemon nothing.
const EVERY: Duration = Duration::from_secs(30);

/// Returns freed memory to the kernel at regular intervals. The allocator keeps free memory below anything that is
/// still in use: after a thousand connections had ended, 62 of its 64 MB were free, and after another thousand it held
/// more.
pub async fn trim_periodically() {
    let mut ticks = tokio::time::interval(EVERY);
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        ticks.tick().await;
        servant::process::trim_heap();
    }
}
