//! What a process needs, as the kernel counts it.

use std::fs;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Context, Result, anyhow};

/// Between two looks at the memory.
const PAUSE: Duration = Duration::from_millis(50);

/// Megabytes (10⁶).
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Memory {
    /// Resident.
    pub(crate) rss: f64,
    /// What is shared counted in proportion.
    pub(crate) pss: f64,
}

/// Keeps the most that was seen.
pub(crate) struct Watch {
    over: Arc<AtomicBool>,
    thread: JoinHandle<Result<Memory>>,
}

impl Watch {
    /// Watches the process from now on.
    pub(crate) fn over(pid: i32) -> Self {
        let over = Arc::new(AtomicBool::new(false));
        let ended = over.clone();
        // The kernel's own high-water mark begins anew; where it may not be written, it stays what it is.
        let _ = fs::write(format!("/proc/{pid}/clear_refs"), "5");
        let thread = std::thread::spawn(move || {
            let mut most = Memory::default();
            while !ended.load(Ordering::Relaxed) {
                most.pss = most.pss.max(field(pid, "smaps_rollup", "Pss:")?);
                std::thread::sleep(PAUSE);
            }
            most.rss = field(pid, "status", "VmHWM:")?;
            Ok(most)
        });
        Self { over, thread }
    }

    /// The most since.
    pub(crate) fn end(self) -> Result<Memory> {
        self.over.store(true, Ordering::Relaxed);
        self.thread
            .join()
            .map_err(|_| anyhow!("the memory's watch panicked"))?
    }
}

/// Megabytes now.
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

/// Time on a processor so far, of all threads, in steps of 10 ms.
pub(crate) fn processor(pid: i32) -> Result<Duration> {
    let path = format!("/proc/{pid}/stat");
    let text = fs::read_to_string(&path).with_context(|| path.clone())?;
    // After the name in parentheses: state is field 3; utime and stime are 14 and 15.
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
