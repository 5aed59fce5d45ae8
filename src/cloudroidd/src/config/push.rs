//! `[push]`: how big pushes may be, and what building them may take.

use anyhow::bail;
use api::{Limits, Size};
use choreographer::limits::check as check_limits;
use serde::Deserialize;

use super::Time;

/// How big pushes may be, and what building them may take.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Push {
    /// Bytes of the archive as sent.
    pub archive: Size,
    /// Bytes of the files in it, unpacked.
    pub unpacked: Size,
    /// How many files the archive may have.
    pub entries: u64,
    /// How long the nodes may take to show their interface.
    pub probe: Time,
    /// How long the archive may pause while it is sent.
    pub stall: Time,
    /// Bytes of the archive that must come in a second, on the average over times of `stall`; 0 for any.
    pub min_rate: Size,
    /// Pushes that are built at once; others wait.
    pub at_once: usize,
    /// Pushes that may wait.
    pub queue: usize,
    /// Time from the start of a push's build (after waiting) to its end.
    pub time: Time,
    /// Bytes of a push's files while it is built; each file counts at least 4 KiB.
    pub disk: Size,
    /// Bytes that stay free on the disks that pushes write to, though no more than a twentieth of a disk.
    pub free: Size,
    /// Bytes of the images of all services of one deployer; 0 for any.
    pub per_deployer: Size,
    /// Bytes of layers and packages in the cache of builds.
    pub cache: Size,
    /// Cores of each container of a build; as many as servants leave when not set.
    pub cpus: Option<f64>,
    /// Memory of each; half of the machine's when not set.
    pub memory: Option<Size>,
    /// Processes and threads of each.
    pub pids: u64,
}

impl Default for Push {
    fn default() -> Self {
        Push {
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

impl Push {
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
        Ok(check_limits(&Limits {
            cpus: self.cpus,
            memory: self.memory,
            pids: Some(self.pids),
            ..Limits::default()
        })?)
    }
}
