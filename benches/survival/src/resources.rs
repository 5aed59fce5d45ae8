//! What the daemon's process holds, as the kernel counts it: whether that stays the same however long it works.

use std::fs;
use std::time::Duration;

use anyhow::{Context, Result};
use bench_report::{Report, Target};

/// Threads that wait for more of their work end after 10 s; what was freed is given back every 30 s.
const REST: Duration = Duration::from_secs(45);
/// Looks that make one figure, and the pause between them.
const LOOKS: usize = 9;
const PAUSE: Duration = Duration::from_millis(250);
/// What counts as the same.
const FLAT: f64 = 1.02;

/// At one time.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Resources {
    /// Resident megabytes (10⁶).
    pub(crate) resident: f64,
    /// Those of them that are no file's: what it allocated.
    pub(crate) anonymous: f64,
    /// Resident ones, what is shared counted in proportion (PSS): fewer where more processes of the program run.
    pub(crate) proportional: f64,
    /// Open descriptors.
    pub(crate) descriptors: f64,
    /// Threads.
    pub(crate) threads: f64,
}

impl Resources {
    /// Those of a process now.
    pub(crate) fn of(pid: i32) -> Result<Self> {
        let megabytes =
            |file, name| Ok::<f64, anyhow::Error>(field(pid, file, name)? * 1024.0 / 1e6);
        Ok(Self {
            resident: megabytes("status", "VmRSS:")?,
            anonymous: megabytes("status", "RssAnon:")?,
            proportional: megabytes("smaps_rollup", "Pss:")?,
            descriptors: fs::read_dir(format!("/proc/{pid}/fd"))?.count() as f64,
            threads: field(pid, "status", "Threads:")?,
        })
    }

    /// Those of a process that was left alone for a while.
    pub(crate) fn at_rest(pid: i32) -> Result<Self> {
        std::thread::sleep(REST);
        let mut looks = Vec::new();
        for _ in 0..LOOKS {
            looks.push(Self::of(pid)?);
            std::thread::sleep(PAUSE);
        }
        Ok(Self::median(&looks))
    }

    /// The middle of many looks, each number by itself.
    pub(crate) fn median(looks: &[Self]) -> Self {
        let middle = |pick: fn(&Self) -> f64| {
            let all: Vec<f64> = looks.iter().map(pick).collect();
            bench_report::quantile(&all, 0.5).unwrap_or(f64::NAN)
        };
        Self {
            resident: middle(|look| look.resident),
            anonymous: middle(|look| look.anonymous),
            proportional: middle(|look| look.proportional),
            descriptors: middle(|look| look.descriptors),
            threads: middle(|look| look.threads),
        }
    }

    /// Adds figures of what it is now, after `what`, beside what it was `before`.
    pub(crate) fn tell(self, report: &mut Report, what: &str, (when, before): (&str, Self)) {
        report
            .figure(
                format!("memory of the daemon after {what}, resident"),
                "MB",
                self.resident,
            )
            .beside(when, before.resident)
            .reach(Target::RatioAtMost(FLAT))
            .note(format!(
                "allocated {:.1} MB after {:.1} MB; PSS {:.1} MB after {:.1} MB",
                self.anonymous, before.anonymous, self.proportional, before.proportional
            ));
        report
            .figure(
                format!("open descriptors of the daemon after {what}"),
                "",
                self.descriptors,
            )
            .beside(when, before.descriptors)
            .reach(Target::RatioAtMost(FLAT))
            .note(format!("{} threads after {}", self.threads, before.threads));
    }
}

/// A number of a file below `/proc/PID`.
fn field(pid: i32, file: &str, name: &str) -> Result<f64> {
    let path = format!("/proc/{pid}/{file}");
    let text = fs::read_to_string(&path).with_context(|| path.clone())?;
    let line = text.lines().find_map(|line| line.strip_prefix(name));
    let line = line.with_context(|| format!("{name} in {path}"))?;
    Ok(line.trim().trim_end_matches("kB").trim().parse()?)
}
