//! What ties the daemon to its supervisor (systemd, a shell): signals, readiness, the watchdog.

use std::time::Duration;

use sd_notify::NotifyState;
use tokio::signal::unix::{Signal, SignalKind, signal};

/// Signals that ask for the daemon's end.
pub struct Signals {
    terminate: Signal,
    interrupt: Signal,
}

impl Signals {
    /// From now on.
    pub fn new() -> std::io::Result<Signals> {
        Ok(Signals {
            terminate: signal(SignalKind::terminate())?,
            interrupt: signal(SignalKind::interrupt())?,
        })
    }

    /// Comes back when one has come.
    pub async fn end_asked(&mut self) {
        tokio::select! {
            _ = self.terminate.recv() => {}
            _ = self.interrupt.recv() => {}
        }
    }
}

/// Tells systemd that requests are answered, and keeps its watchdog quiet from now on.
pub fn ready() {
    tell(&[NotifyState::Ready]);
    let mut microseconds = 0;
    if sd_notify::watchdog_enabled(false, &mut microseconds) {
        let interval = Duration::from_micros(microseconds / 2);
        tokio::spawn(async move {
            let mut ticks = tokio::time::interval(interval);
            loop {
                ticks.tick().await;
                tell(&[NotifyState::Watchdog]);
            }
        });
    }
}

/// Tells systemd that the daemon is ending.
pub fn stopping() {
    tell(&[NotifyState::Stopping]);
}

fn tell(state: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(false, state) {
        tracing::debug!("systemd was not told: {error}");
    }
}

/// How much the whole machine waits; none where its kernel does not tell (PSI).
pub fn machine_pressure() -> Option<api::Pressure> {
    let some = |name: &str| {
        let text = std::fs::read_to_string(format!("/proc/pressure/{name}")).ok()?;
        let line = text.lines().find_map(|line| line.strip_prefix("some "))?;
        line.split(' ')
            .find_map(|pair| pair.strip_prefix("avg10=")?.parse().ok())
    };
    Some(api::Pressure {
        cpu: some("cpu")?,
        memory: some("memory")?,
        io: some("io")?,
    })
}

/// Nine tenths of the machine's memory.
pub fn machine_memory() -> u64 {
    let text = std::fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let kilobytes = text
        .lines()
        .find_map(|line| line.strip_prefix("MemTotal:"))
        .and_then(|rest| rest.trim().trim_end_matches(" kB").parse::<u64>().ok());
    kilobytes.map_or(1 << 30, |kilobytes| kilobytes * 1024 / 10 * 9)
}
