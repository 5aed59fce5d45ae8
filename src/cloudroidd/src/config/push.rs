//! `[push]`: limits of pushes and their builds.

use anyhow::bail;
use api::Size;
use serde::Deserialize;

use super::Time;

/// Limits of pushes and their builds.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PushConfig {
    /// Largest archive as sent, in bytes.
    pub archive: Size,
    /// Largest total size of the unpacked files, in bytes.
    pub unpacked: Size,
    /// Largest number of files in the archive.
    pub entries: u64,
    /// Time that the nodes have to show their interface.
    pub probe: Time,
    /// Longest pause while the archive is sent.
    pub stall: Time,
    /// Lowest rate at which the archive must arrive, in bytes per second, averaged over `stall`; 0 accepts any.
    pub min_rate: Size,
    /// Largest number of pushes that are built concurrently; others wait.
    pub at_once: usize,
    /// Largest number of pushes that wait or are being sent.
    pub queue: usize,
    /// Longest duration of a push, without the time that it waits for others.
    pub time: Time,
    /// Disk space of a push's files while it is built; each file counts at least 4 KiB.
    pub disk: Size,
    /// Space that stays free on the disks that pushes write to, but at most a twentieth of a disk.
    pub free: Size,
    /// Largest total size of the images of one deployer's services; 0 for no limit.
    pub per_deployer: Size,
    /// Size of the build cache for layers and packages.
    pub cache: Size,
    /// Cores of each build container (default: those that servants leave).
    pub cpus: Option<f64>,
    /// Memory of each build container (default: half of the machine's).
    pub memory: Option<Size>,
    /// Processes and threads of each build container.
    pub pids: u64,
}

impl Default for PushConfig {
    fn default() -> Self {
        PushConfig {
            archive: Size(2 << 30),
            unpacked: Size(8 << 30),
            entries: 500_000,
            probe: Time::seconds(30),
            stall: Time::seconds(60),
            min_rate: Size(1 << 10),
            at_once: 2,
            queue: 16,
            time: Time::seconds(2 * 3600),
            disk: Size(20 << 30),
            free: Size(2 << 30),
            per_deployer: Size(50 << 30),
            cache: Size(30 << 30),
            cpus: None,
            memory: None,
            pids: 4096,
        }
    }
}

impl PushConfig {
    pub(super) fn check(&self) -> anyhow::Result<()> {
        if self.at_once == 0 {
            bail!("at_once = 0 would let no push be built; write at least 1");
        }
        if self.disk.0 == 0 || self.time.0.is_zero() || self.stall.0.is_zero() {
            bail!("a disk, time or stall of 0 would end every push");
        }
        let sent = [self.archive.0, self.unpacked.0, self.entries];
        if sent.contains(&0) || self.probe.0.is_zero() {
            bail!("an archive, unpacked, entries or probe of 0 would refuse every push");
        }
        Ok(self.limits().check()?)
    }
}
