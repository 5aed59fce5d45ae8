//! Resources of processes, from the kernel's counters.

use std::fs;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use bench_servant::Daemon;
use servant::launch::{self, RuntimeRecord};

/// The processes of a servant other than its nodes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ServantOverhead {
    /// Pid of the shim.
    pub(crate) shim: i32,
    /// Pid of the container's PID 1, a child of the shim.
    pub(crate) init: i32,
}

impl ServantOverhead {
    /// Returns the processes of every servant.
    pub(crate) fn for_all_servants(daemon: &Daemon) -> Result<Vec<Self>> {
        daemon
            .servants()?
            .iter()
            .map(|id| Self::for_servant(daemon, id))
            .collect()
    }

    fn for_servant(daemon: &Daemon, id: &str) -> Result<Self> {
        let path = daemon
            .home()
            .join("servants")
            .join(id)
            .join(launch::RUNTIME);
        let runtime: RuntimeRecord = launch::read_record(&path)?
            .with_context(|| format!("{} is missing", path.display()))?;
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

    /// Returns the memory of both in megabytes (10⁶).
    pub(crate) fn memory(self) -> Result<f64> {
        Ok(proportional_memory(self.shim)? + proportional_memory(self.init)?)
    }
}

/// Returns the proportional set size of a process in megabytes (10⁶).
pub(crate) fn proportional_memory(pid: i32) -> Result<f64> {
    let path = format!("/proc/{pid}/smaps_rollup");
    let text = fs::read_to_string(&path).with_context(|| path.clone())?;
    let line = text
        .lines()
        .find_map(|line| line.strip_prefix("Pss:"))
        .context(path)?;
    let kilobytes: f64 = line.trim().trim_end_matches("kB").trim().parse()?;
    Ok(kilobytes * 1024.0 / 1e6)
}

/// Returns the processor time of all threads so far, including those that have ended.
#[allow(unsafe_code)]
pub(crate) fn processor_time(pid: i32) -> Result<Duration> {
    let (mut clock, mut time) = (
        0,
        libc::timespec {
            tv_sec: 0,
            tv_nsec: 0,
        },
    );
    // SAFETY: both write through their last argument, which points to a live local variable of the right type.
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
