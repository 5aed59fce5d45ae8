//! Resources of processes, from the kernel's counters.

use std::time::Duration;

use anyhow::{Context, Result, ensure};
use bench_report::{BenchDaemon, Process, first_child};
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
    pub(crate) fn for_all_servants(daemon: &BenchDaemon) -> Result<Vec<Self>> {
        daemon.servants()?.iter().map(|id| Self::for_servant(daemon, id)).collect()
    }

    fn for_servant(daemon: &BenchDaemon, id: &str) -> Result<Self> {
        let path = daemon.home.join("servants").join(id).join(launch::RUNTIME);
        let runtime: RuntimeRecord =
            launch::read_record(&path)?.with_context(|| format!("{} is missing", path.display()))?;
        let shim = runtime.shim.pid;
        Ok(Self { shim, init: first_child(shim)? })
    }

    /// Returns the memory of both in megabytes (10⁶).
    pub(crate) fn memory(self) -> Result<f64> {
        Ok(Process::from_pid(self.shim).proportional()? + Process::from_pid(self.init).proportional()?)
    }
}

/// Returns the processor time of all threads so far, including those that have ended.
#[allow(unsafe_code)]
pub(crate) fn processor_time(pid: i32) -> Result<Duration> {
    let (mut clock, mut time) = (0, libc::timespec { tv_sec: 0, tv_nsec: 0 });
    // SAFETY: both write through their last argument, which points to a live local variable of the right type.
    let told = unsafe { libc::clock_getcpuclockid(pid, &mut clock) == 0 && libc::clock_gettime(clock, &mut time) == 0 };
    ensure!(told, "the processor time of process {pid} is not told: it has ended");
    Ok(Duration::new(time.tv_sec as u64, time.tv_nsec as u32))
}
