use std::time::Duration;

use api::Size;

/// Limits on the size of pushes and on the resources for building them.
#[derive(Debug, Clone)]
pub struct Options {
    /// Maximum size of the archive as sent.
    pub archive: Size,
    /// Maximum total size of the unpacked files.
    pub unpacked: Size,
    /// Maximum number of files in the archive.
    pub entries: u64,
    /// Maximum time for the nodes to show their interface.
    pub probe: Duration,
    /// Maximum pause while the archive is sent.
    pub stall: Duration,
    /// Minimum transfer rate of the archive in bytes per second, averaged over `stall`; 0 for none.
    pub min_rate: Size,
    /// Maximum number of concurrent builds; further pushes wait.
    pub at_once: usize,
    /// Maximum number of pushes that wait or are being sent.
    pub queue: usize,
    /// Maximum duration of a push from the start of its build, not counting the time it waits.
    pub time: Duration,
    /// Maximum size of a push's files during the build; each file counts at least 4 KiB.
    pub disk: Size,
    /// Minimum free space on the disks that pushes write to, at most 1/20 of each disk.
    pub free: Size,
    /// Maximum total size of the images of one deployer's services; 0 for unlimited.
    pub per_deployer: Size,
}

#[cfg(test)]
impl Options {
    /// Limits that no test reaches unless it sets one.
    pub(crate) fn unlimited() -> Options {
        Options {
            archive: Size(2 << 30),
            unpacked: Size(8 << 30),
            entries: 500_000,
            probe: Duration::from_secs(30),
            stall: Duration::from_secs(60),
            min_rate: Size(1 << 10),
            at_once: 2,
            queue: 16,
            time: Duration::from_secs(7200),
            disk: Size(20 << 30),
            free: Size(0),
            per_deployer: Size(0),
        }
    }
}
