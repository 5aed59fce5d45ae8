//! What roles say to the program that started them, and the times of their exchanges.

use std::io::Read;
use std::time::Duration;

use anyhow::{Context, Result};
use bench_report::quantile_seconds;
use futures_util::FutureExt as _;
use serde_json::{Value, json};

/// Time after which an answer counts as missing.
pub(crate) const PATIENCE: Duration = Duration::from_secs(2);
/// Number of warm-up exchanges, which are not counted.
const WARM: usize = 10;

/// Prints a line of JSON.
pub(crate) fn print_json(line: &Value) {
    println!("{line}");
}

/// Says that the role is ready.
pub(crate) fn print_ready() {
    print_json(&json!({}));
}

/// Waits for a request of the parent, or for its end; returns whether it was a request.
pub(crate) async fn wait_for_request() -> Result<bool> {
    let ask = || std::io::stdin().read(&mut [0]);
    Ok(tokio::task::spawn_blocking(ask).await?? > 0)
}

/// Makes `count` exchanges after some that warm up, one at a time, and prints quantiles of their microseconds.
pub(crate) async fn time_exchanges(
    count: usize,
    mut exchange: impl AsyncFnMut(usize) -> Result<Duration>,
) -> Result<()> {
    print_ready();
    let mut times = Vec::with_capacity(count);
    for number in 0..count + WARM {
        let took = exchange(number).await?;
        times.extend((number >= WARM).then_some(took));
    }
    let micros = |share| quantile_seconds(&times, share) * 1e6;
    print_json(&json!({"p50": micros(0.5), "p99": micros(0.99)}));
    Ok(())
}

/// Does the same with an exchange that blocks.
pub(crate) fn time_blocking(count: usize, mut exchange: impl FnMut(usize) -> Result<Duration>) -> Result<()> {
    let times = time_exchanges(count, async |number| exchange(number));
    times.now_or_never().context("an exchange that blocks is never pending")?
}
