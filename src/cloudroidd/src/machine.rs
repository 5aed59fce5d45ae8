//! What this machine has: cores and memory.

/// What a machine has.
#[derive(Debug, Clone, Copy)]
pub struct Has {
    /// Cores.
    pub cores: f64,
    /// Bytes of memory, all of them.
    pub memory: u64,
}

/// Cores of this machine that this process may use.
pub fn cores() -> f64 {
    std::thread::available_parallelism().map_or(1.0, |cores| cores.get() as f64)
}

/// What this machine has.
pub fn has() -> Has {
    Has {
        cores: cores(),
        memory: servant::host::memory().unwrap_or(u64::MAX),
    }
}

/// Nine tenths of the machine's memory.
pub fn most_memory() -> u64 {
    servant::host::memory().map_or(1 << 30, |bytes| bytes / 10 * 9)
}
