//! Resources of a process, from the kernel's counters.

use std::fs;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Context, Result, anyhow};

/// Sampling interval of the memory.
const PAUSE: Duration = Duration::from_millis(50);

/// Memory in megabytes (10⁶).
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct PeakMemory {
    /// Resident set size.
    pub(crate) rss: f64,
    /// Proportional set size: shared pages are divided among their users.
    pub(crate) pss: f64,
}

/// A thread that records the peak memory of a process.
pub(crate) struct MemoryWatch {
    over: Arc<AtomicBool>,
    thread: JoinHandle<Result<PeakMemory>>,
}

impl MemoryWatch {
    /// Starts to watch a process.
    pub(crate) fn start(pid: i32) -> Self {
        let over = Arc::new(AtomicBool::new(false));
        let ended = over.clone();
        // Resets the kernel's own high-water mark; without permission it keeps its value.
        let _ = fs::write(format!("/proc/{pid}/clear_refs"), "5");
        let thread = std::thread::spawn(move || {
            let mut most = PeakMemory::default();
            while !ended.load(Ordering::Relaxed) {
                most.pss = most.pss.max(field(pid, "smaps_rollup", "Pss:")?);
                std::thread::sleep(PAUSE);
            }
            most.rss = field(pid, "status", "VmHWM:")?;
            Ok(most)
        });
        Self { over, thread }
    }

    /// Stops watching and returns the peak since the start.
    pub(crate) fn stop(self) -> Result<PeakMemory> {
        self.over.store(true, Ordering::Relaxed);
        self.thread
            .join()
            .map_err(|_| anyhow!("the memory's watch panicked"))?
    }
}

/// Returns the resident memory in megabytes.
pub(crate) fn resident(pid: i32) -> Result<f64> {
    field(pid, "status", "VmRSS:")
}

fn field(pid: i32, file: &str, name: &str) -> Result<f64> {
    let path = format!("/proc/{pid}/{file}");
    let text = fs::read_to_string(&path).with_context(|| path.clone())?;
    let line = text.lines().find_map(|line| line.strip_prefix(name));
    let kilobytes = line
        .with_context(|| format!("{name} in {path}"))?
        .trim()
        .trim_end_matches("kB");
    Ok(kilobytes.trim().parse::<f64>()? * 1024.0 / 1e6)
}

/// Returns the processor time of all threads so far, in steps of 10 ms.
pub(crate) fn processor_time(pid: i32) -> Result<Duration> {
    let path = format!("/proc/{pid}/stat");
    let text = fs::read_to_string(&path).with_context(|| path.clone())?;
    // The fields after the name in parentheses start with state, field 3; utime and stime are 14 and 15.
    let fields = text
        .rsplit(')')
        .next()
        .unwrap_or_default()
        .split_whitespace();
    let ticks: u64 = fields
        .skip(11)
        .take(2)
        .filter_map(|field| field.parse::<u64>().ok())
        .sum();
    Ok(Duration::from_millis(ticks * 10))
}
