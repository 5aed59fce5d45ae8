//! What ties the daemon to its supervisor (systemd, a shell): signals, readiness, the watchdog.

use std::time::Duration;

use sd_notify::NotifyState;
use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

/// Hears of signals that ask for the daemon's end: the first cancels what this gives. The second ends the process at
/// once, whatever it is doing, after `at_once`; servants go on, and the next daemon sweeps what was half-made.
pub fn end_asked(at_once: impl FnOnce() + Send + 'static) -> std::io::Result<CancellationToken> {
    let mut terminate = signal(SignalKind::terminate())?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    let asked = CancellationToken::new();
    let first = asked.clone();
    tokio::spawn(async move {
        for time in 0..2 {
            tokio::select! {
                _ = terminate.recv() => {}
                _ = interrupt.recv() => {}
            }
            if time == 0 {
                first.cancel();
            }
        }
        tracing::warn!("asked a second time: ending at once");
        at_once();
        std::process::exit(1);
    });
    Ok(asked)
}

/// Tells systemd that requests are answered, and keeps its watchdog quiet from now on.
pub fn ready() {
    report(&[NotifyState::Ready]);
    let mut microseconds = 0;
    if sd_notify::watchdog_enabled(false, &mut microseconds) {
        let interval = Duration::from_micros(microseconds / 2);
        tokio::spawn(async move {
            let mut ticks = tokio::time::interval(interval);
            loop {
                ticks.tick().await;
                report(&[NotifyState::Watchdog]);
            }
        });
    }
}

/// Tells systemd that the daemon is ending.
pub fn stopping() {
    report(&[NotifyState::Stopping]);
}

fn report(state: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(false, state) {
        tracing::debug!("systemd was not told: {error}");
    }
}
