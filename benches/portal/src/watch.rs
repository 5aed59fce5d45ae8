//! Peak memory of a process.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Result, anyhow};
use bench_report::Process;

/// Sampling interval of the memory.
const PAUSE: Duration = Duration::from_millis(50);

/// Memory in megabytes (10⁶).
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct PeakMemory {
    /// Resident set size.
    pub(crate) resident: f64,
    /// Proportional set size: shared pages are divided among their users.
    pub(crate) proportional: f64,
}

/// A thread that records the peak memory of a process.
pub(crate) struct MemoryWatch {
    over: Arc<AtomicBool>,
    thread: JoinHandle<Result<PeakMemory>>,
}

impl MemoryWatch {
    /// Starts to watch a process.
    pub(crate) fn start(process: Process) -> Self {
        let over = Arc::new(AtomicBool::new(false));
        let ended = over.clone();
        // Without permission the kernel's own high-water mark keeps its value.
        let _ = process.reset_peak();
        let thread = std::thread::spawn(move || {
            let mut most = PeakMemory::default();
            while !ended.load(Ordering::Relaxed) {
                most.proportional = most.proportional.max(process.proportional()?);
                std::thread::sleep(PAUSE);
            }
            most.resident = process.peak()?;
            Ok(most)
        });
        Self { over, thread }
    }

    /// Stops watching and returns the peak since the start.
    pub(crate) fn stop(self) -> Result<PeakMemory> {
        self.over.store(true, Ordering::Relaxed);
        self.thread.join().map_err(|_| anyhow!("the memory's watch panicked"))?
    }
}
