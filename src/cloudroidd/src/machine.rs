//! Resources of this machine: cores, memory and file descriptors.

use nix::sys::resource::{Resource, getrlimit, setrlimit};

/// File descriptors that the daemon requests, as its systemd unit does: for connections, servants and files of images.
const DESCRIPTORS: u64 = 1 << 19;

/// Resources of a machine.
#[derive(Debug, Clone, Copy)]
pub struct MachineResources {
    /// Number of cores.
    pub cores: f64,
    /// Total memory in bytes.
    pub memory: u64,
}

/// Returns the number of cores that this process may use.
pub fn cores() -> f64 {
    std::thread::available_parallelism().map_or(1.0, |cores| cores.get() as f64)
}

/// Returns the resources of this machine.
pub fn resources() -> MachineResources {
    MachineResources { cores: cores(), memory: servant::host::total_memory().unwrap_or(u64::MAX) }
}

/// Returns nine tenths of the machine's memory.
pub fn usable_memory() -> u64 {
    servant::host::total_memory().map_or(1 << 30, |bytes| bytes / 10 * 9)
}

/// Returns the number of file descriptors that this process may open.
pub fn descriptor_limit() -> u64 {
    // Fails for unknown resources only.
    getrlimit(Resource::RLIMIT_NOFILE).map_or(1024, |(soft, _)| soft)
}

/// Raises the soft limit of file descriptors as far as the hard limit allows: shells start with 1,024.
pub fn raise_descriptor_limit() -> nix::Result<()> {
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
        raise_descriptor_limit().expect("raised");
        assert_eq!(descriptor_limit(), hard.min(DESCRIPTORS));
        // A higher limit is kept.
        raise_descriptor_limit().expect("kept");
        assert_eq!(descriptor_limit(), hard.min(DESCRIPTORS));
    }
}
