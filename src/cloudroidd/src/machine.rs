//! What this machine has: cores, memory and descriptors.

use nix::sys::resource::{Resource, getrlimit, setrlimit};

/// Descriptors that the daemon asks for, as its unit does: connections, servants, files of images.
const DESCRIPTORS: u64 = 1 << 19;

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

/// How many descriptors this process may have open.
pub fn descriptors() -> u64 {
    // It fails for no resource that there is.
    getrlimit(Resource::RLIMIT_NOFILE).map_or(1024, |(soft, _)| soft)
}

/// Raises the number of descriptors that this process may have open as far as it may by itself: shells give 1,024.
pub fn raise_descriptors() -> nix::Result<()> {
    let (soft, hard) = getrlimit(Resource::RLIMIT_NOFILE)?;
    let most = hard.min(DESCRIPTORS);
    if soft >= most {
        return Ok(());
    }
    setrlimit(Resource::RLIMIT_NOFILE, most, hard)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shells_few_descriptors_are_raised_as_far_as_may_be() {
        let (_, hard) = getrlimit(Resource::RLIMIT_NOFILE).expect("a limit");
        setrlimit(Resource::RLIMIT_NOFILE, hard.min(1000), hard).expect("lowered");
        raise_descriptors().expect("raised");
        assert_eq!(descriptors(), hard.min(DESCRIPTORS));
        // What was given more keeps it.
        raise_descriptors().expect("kept");
        assert_eq!(descriptors(), hard.min(DESCRIPTORS));
    }
}
