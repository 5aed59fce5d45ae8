//! What all roles have in common: the conversation with the parent, limits, and quantiles.

use std::io::Read;
use std::time::Duration;

use anyhow::Result;
use bench_report::quantile_seconds;
use serde_json::{Value, json};

/// Address of the plain datagram echo.
pub(crate) const ECHO: &str = "127.0.0.1:20000";
/// A datagram of the length of a String within RTPS.
pub(crate) const DATAGRAM: [u8; 128] = [7; 128];
/// Time after which an answer counts as missing.
pub(crate) const PATIENCE: Duration = Duration::from_secs(2);
/// Number of warm-up exchanges, which are not counted.
pub(crate) const WARM: usize = 10;

/// Prints a line of JSON.
pub(crate) fn print_json(line: &Value) {
    println!("{line}");
}

/// Waits for a request of the parent, or for its end; returns whether it was a request.
pub(crate) async fn wait_for_request() -> Result<bool> {
    let ask = || std::io::stdin().read(&mut [0]);
    Ok(tokio::task::spawn_blocking(ask).await?? > 0)
}

pub(crate) fn quantiles(times: &[Duration]) -> Value {
    let micros = |share| quantile_seconds(times, share) * 1e6;
    json!({"p50": micros(0.5), "p99": micros(0.99)})
}
