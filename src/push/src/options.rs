use std::time::Duration;

use api::Size;

/// How big pushes may be, and what building them may take.
#[derive(Debug, Clone)]
pub struct Options {
    /// Bytes of the archive as sent.
    pub archive: Size,
    /// Bytes of the files in it, unpacked.
    pub unpacked: Size,
    /// How many files the archive may have.
    pub entries: u64,
    /// How long the nodes may take to show their interface.
    pub probe: Duration,
    /// How long the archive may pause while it is sent.
    pub stall: Duration,
    /// Bytes of the archive that must come in a second, on the average over times of `stall`; 0 for any.
    pub min_rate: Size,
    /// Pushes that are built at once; others wait.
    pub at_once: usize,
    /// Pushes that may wait.
    pub queue: usize,
    /// Time from the start of a push's build (after waiting) to its end.
    pub time: Duration,
    /// Bytes of a push's files while it is built; each file counts at least 4 KiB.
    pub disk: Size,
    /// Bytes that stay free on the disks that pushes write to, though no more than a twentieth of a disk.
    pub free: Size,
    /// Bytes of the images of all services of one deployer; 0 for any.
    pub per_deployer: Size,
}

#[cfg(test)]
impl Options {
    /// Limits that no test reaches unless it sets one.
    pub(crate) fn wide() -> Options {
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
