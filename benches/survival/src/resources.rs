//! Resources of the daemon's process, from the kernel's counters: they should not grow, however long it works.

use std::time::Duration;

use anyhow::{Context, Result, ensure};
use bench_report::{BenchReport, Process, Target};
use support::daemon::Daemon;

/// Idle threads of a pool end after 10 s, and freed memory is returned every 30 s.
const REST: Duration = Duration::from_secs(45);
/// Number of samples per figure, and the pause between them.
const LOOKS: usize = 9;
const PAUSE: Duration = Duration::from_millis(250);
/// Ratio up to which two values count as equal.
const FLAT: f64 = 1.02;

/// Resources at one moment.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Resources {
    /// Resident memory in megabytes (10⁶).
    pub(crate) resident: f64,
    /// Anonymous resident memory, which excludes files: what is allocated, and free memory between.
    pub(crate) anonymous: f64,
    /// Memory that the daemon has allocated and not freed, by its own metric.
    pub(crate) allocated: f64,
    /// Proportional set size: less the more processes of the program run.
    pub(crate) proportional: f64,
    /// Open descriptors.
    pub(crate) descriptors: f64,
    /// Threads.
    pub(crate) threads: f64,
}

impl Resources {
    /// Reads the resources of a daemon.
    pub(crate) fn read(daemon: &Daemon) -> Result<Self> {
        let process = Process::from_pid(daemon.pid());
        Ok(Self {
            resident: process.resident()?,
            anonymous: process.anonymous()?,
            allocated: read_allocated(daemon)?,
            proportional: process.proportional()?,
            descriptors: process.descriptors()? as f64,
            threads: process.threads()? as f64,
        })
    }

    /// Reads the resources of a daemon after an idle period.
    pub(crate) fn read_at_rest(daemon: &Daemon) -> Result<Self> {
        std::thread::sleep(REST);
        let mut looks = Vec::new();
        for _ in 0..LOOKS {
            looks.push(Self::read(daemon)?);
            std::thread::sleep(PAUSE);
        }
        Ok(Self::median(&looks))
    }

    /// Returns the median of each number over several samples.
    pub(crate) fn median(looks: &[Self]) -> Self {
        let middle = |pick: fn(&Self) -> f64| {
            let all: Vec<f64> = looks.iter().map(pick).collect();
            bench_report::quantile(&all, 0.5).unwrap_or(f64::NAN)
        };
        Self {
            resident: middle(|look| look.resident),
            anonymous: middle(|look| look.anonymous),
            allocated: middle(|look| look.allocated),
            proportional: middle(|look| look.proportional),
            descriptors: middle(|look| look.descriptors),
            threads: middle(|look| look.threads),
        }
    }

    /// Adds figures for the current values, after `what`, compared with those from `before`.
    pub(crate) fn add_figures(self, report: &mut BenchReport, what: &str, (when, before): (&str, Self)) {
        let title = format!("memory of the daemon after {what}, resident");
        report
            .figure(title, "MB", self.resident)
            .relative_to(when, before.resident)
            .require(Target::RatioAtMost(FLAT))
            .note(format!(
                "anonymous {:.1} MB after {:.1} MB; PSS {:.1} MB after {:.1} MB",
                self.anonymous, before.anonymous, self.proportional, before.proportional
            ));
        let title = format!("memory that the daemon has allocated after {what}");
        report
            .figure(title, "MB", self.allocated)
            .relative_to(when, before.allocated)
            .require(Target::RatioAtMost(FLAT));
        let title = format!("open descriptors of the daemon after {what}");
        report
            .figure(title, "", self.descriptors)
            .relative_to(when, before.descriptors)
            .require(Target::RatioAtMost(FLAT))
            .note(format!("{} threads after {}", self.threads, before.threads));
    }
}

/// Returns `cloudroid_heap_bytes` in megabytes.
fn read_allocated(daemon: &Daemon) -> Result<f64> {
    let (status, text) = daemon.request("GET", "/metrics", &[])?;
    ensure!(status == 200, "{text}");
    let value = text.lines().find_map(|line| line.strip_prefix("cloudroid_heap_bytes "));
    let bytes: f64 = value.context("cloudroid_heap_bytes")?.parse()?;
    Ok(bytes / 1e6)
}
