//! The daemon's interface to its supervisor (systemd, a shell): signals, readiness, the watchdog.

use std::time::Duration;

use sd_notify::NotifyState;
use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

/// Handles the signals that ask the daemon to end: the first one cancels the returned token. The second one ends the
/// process at once, whatever it is doing, after `at_once`; servants go on, and the next daemon removes what is
/// unfinished.
pub fn termination_token(at_once: impl FnOnce() + Send + 'static) -> std::io::Result<CancellationToken> {
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
        tracing::warn!("second signal: stopping at once");
        at_once();
        std::process::exit(1);
    });
    Ok(asked)
}

/// Tells systemd that the daemon is ready, and serves its watchdog from now on.
pub fn notify_ready() {
    notify(&[NotifyState::Ready]);
    let mut microseconds = 0;
    if sd_notify::watchdog_enabled(false, &mut microseconds) {
        let interval = Duration::from_micros(microseconds / 2);
        tokio::spawn(async move {
            let mut ticks = tokio::time::interval(interval);
            loop {
                ticks.tick().await;
                notify(&[NotifyState::Watchdog]);
            }
        });
    }
}

/// Tells systemd that the daemon is ending.
pub fn notify_stopping() {
    notify(&[NotifyState::Stopping]);
}

fn notify(state: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(false, state) {
        tracing::debug!("cannot notify systemd: {error}");
    }
}
