//! What processes cost, as the kernel counts it.

use std::fs;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use bench_servant::Daemon;
use servant::launch::{self, Runtime};

/// The processes of one servant that are not its nodes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Overhead {
    /// The shim.
    pub(crate) shim: i32,
    /// PID 1 of the container, the shim's child.
    pub(crate) init: i32,
}

impl Overhead {
    /// Those of every servant.
    pub(crate) fn all(daemon: &Daemon) -> Result<Vec<Self>> {
        daemon
            .servants()?
            .iter()
            .map(|id| Self::of(daemon, id))
            .collect()
    }

    fn of(daemon: &Daemon, id: &str) -> Result<Self> {
        let path = daemon
            .home()
            .join("servants")
            .join(id)
            .join(launch::RUNTIME);
        let runtime: Runtime =
            launch::read(&path)?.with_context(|| format!("{} is missing", path.display()))?;
        let shim = runtime.shim.pid;
        let children = fs::read_to_string(format!("/proc/{shim}/task/{shim}/children"))?;
        let init = children
            .split_whitespace()
            .next()
            .with_context(|| format!("shim {shim} has no child"))?;
        Ok(Self {
            shim,
            init: init.parse()?,
        })
    }

    /// Megabytes (10⁶) of both.
    pub(crate) fn memory(self) -> Result<f64> {
        Ok(memory(self.shim)? + memory(self.init)?)
    }
}

/// Megabytes (10⁶) of a process, what it shares counted in proportion (PSS).
pub(crate) fn memory(pid: i32) -> Result<f64> {
    let path = format!("/proc/{pid}/smaps_rollup");
    let text = fs::read_to_string(&path).with_context(|| path.clone())?;
    let line = text
        .lines()
        .find_map(|line| line.strip_prefix("Pss:"))
        .context(path)?;
    let kilobytes: f64 = line.trim().trim_end_matches("kB").trim().parse()?;
    Ok(kilobytes * 1024.0 / 1e6)
}

/// Time on a processor so far, of all threads, those that have ended included.
#[allow(unsafe_code)]
pub(crate) fn processor(pid: i32) -> Result<Duration> {
    let (mut clock, mut time) = (
        0,
        libc::timespec {
            tv_sec: 0,
            tv_nsec: 0,
        },
    );
    // SAFETY: both write to what their last argument points to, which is ours and of the right type.
    let told = unsafe {
        libc::clock_getcpuclockid(pid, &mut clock) == 0
            && libc::clock_gettime(clock, &mut time) == 0
    };
    ensure!(
        told,
        "the processor time of process {pid} is not told: it has ended"
    );
    Ok(Duration::new(time.tv_sec as u64, time.tv_nsec as u32))
}
